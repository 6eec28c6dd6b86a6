"""Is a capture what it says it is? What breaks in silence (axes, units, conventions, timing) is said aloud."""
