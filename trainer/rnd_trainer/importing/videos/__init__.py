"""Video files: decoding, orientation and colours."""
