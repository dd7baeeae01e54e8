"""Robot descriptions: one YAML and one MJCF each, in ``robots/``."""
