"""Moved to pipeprog_camera, which the packages share without depending in a circle."""

from pipeprog_camera.camera import DISTORTION_MODELS, Camera

__all__ = ["DISTORTION_MODELS", "Camera"]
