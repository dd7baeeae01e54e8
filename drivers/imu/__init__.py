"""IMUs: a codec of drivers.codecs on a wire."""
