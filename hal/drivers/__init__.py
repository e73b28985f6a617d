"""One device per file: a protocol, a bus, and the conversion to SI units."""
