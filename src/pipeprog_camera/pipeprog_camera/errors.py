# SPDX-License-Identifier: Apache-2.0
"""The one exception for what a user can mend."""


class InputError(Exception):
    """Input that cannot be used: the text names the file, the value and the remedy."""
