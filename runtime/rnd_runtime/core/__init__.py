"""Errors, files, arrays, cameras and kernels that everything else stands on."""
