"""Moved to pipeprog_camera, which the packages share without depending in a circle."""

from pipeprog_camera.errors import InputError

__all__ = ["InputError"]
