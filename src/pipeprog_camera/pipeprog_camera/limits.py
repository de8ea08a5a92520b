# SPDX-License-Identifier: Apache-2.0
"""Limits on what comes from outside, each with its reason: a size that is declared is compared before it is believed.

They bound memory and time, and leave every real recording, file and message through.
"""

from __future__ import annotations

# Images.
MAX_PIXELS = 1 << 26  # px; 67 megapixels, twice the largest video (8K: 33), decoded 200 MB
MIN_SIDE = 32  # px; below, not one window of the tracker fits between the borders of an image
MAX_ENCODED_IMAGE = 1 << 28  # bytes; four for each pixel at MAX_PIXELS: raw frames with an alpha channel
MAX_JPEG_SCANS = 100  # progressive JPEGs have about 10; the decoder passes over the whole image once a scan

# Clouds and trajectories.
MAX_CLOUD_POINTS = 1 << 26  # points; 67 million: a building at 5 mm; 1.6 GB as coordinates in double precision
MAX_POSES = 100_000  # keyframes; 14 hours at two a second
MAX_COORDINATE = 1e8  # m; beyond the coordinates of any map projection (UTM: 1e7)

# Texts and times.
MAX_NAME = 256  # characters of a frame or class name; ROS 2 limits topic names to as many
MAX_SECONDS = 2**31 - 1  # s; builtin_interfaces/Time has 32 bits with a sign
