"""The same frame on an OpenGL device."""
