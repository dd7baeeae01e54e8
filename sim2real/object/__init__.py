"""Where samples of the object come from: packets on the network, or a simulated camera; and the object of a simulation."""
