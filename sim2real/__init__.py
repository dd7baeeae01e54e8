"""The runtime: state -> policy -> safety -> motors. No torch, ever."""
