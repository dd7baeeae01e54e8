"""Codecs: bytes to SI and back, vectorised, one file a protocol, host side and device side. No wire, no clock."""
