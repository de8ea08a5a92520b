# SPDX-License-Identifier: Apache-2.0
"""Synthetic construction sites: geometry, textures, a ray caster and a writer of recordings with ground truth."""
