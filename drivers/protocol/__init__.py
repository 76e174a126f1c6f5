"""Wire formats without input or output: bytes in, messages out, and back."""
