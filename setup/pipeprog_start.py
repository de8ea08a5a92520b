# SPDX-License-Identifier: Apache-2.0
"""Start-up hook of the virtual environment: pipeprog and its messages are found with nothing sourced.

`make setup` copies this file into site-packages, beside a .pth file that imports it when Python starts.
An installed ROS distribution does the same by sourcing its setup file and never sees this hook.
"""

import os
import sys
from pathlib import Path

prefix = Path(sys.prefix)

# The sources come before their installed copies: an edit needs no rebuild.
for package in sorted((prefix.parent / "src").glob("pipeprog*"), reverse=True):
    if (package / package.name / "__init__.py").is_file():
        sys.path.insert(0, str(package))

# ament finds packages, message types and launch files by this variable.
overlays = [path for path in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if path and path != str(prefix)]
os.environ["AMENT_PREFIX_PATH"] = os.pathsep.join([str(prefix), *overlays])

# The wheels' own hook, which runs after this one, sets the library path by starting Python again. Its mark is
# inherited by children; where the parent is the Python of another environment, the path set there is not ours.
libraries = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
if str(prefix / "lib") not in libraries:
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    # Libraries of the same names, built from other messages.
    libraries = [path for path in libraries if path and not (Path(path) / "librcl.so").exists()]
    os.environ["LD_LIBRARY_PATH"] = os.pathsep.join(libraries)
