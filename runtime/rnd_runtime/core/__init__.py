"""Errors, files, arrays, cameras and kernels that everything else uses."""

from .signals import install_in_command

install_in_command()
