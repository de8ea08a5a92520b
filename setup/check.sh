# Is this machine fit to build pipeprog? Says what is missing and how to get it. Usage: check.sh PYTHON [view]
# With `view`: fit for Open3D, which `pipeprog view` draws with.
python=$1
missing=

if ! command -v "$python" >/dev/null; then
    echo "pipeprog needs Python 3.10 to 3.13, and there is no '$python'." >&2
    echo "Install python3 (Debian, Ubuntu: apt-get install python3) or name one: make setup PYTHON=python3.12" >&2
    exit 1
fi
if ! "$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))'; then
    echo "pipeprog needs Python 3.10 to 3.13; '$python' is $("$python" -V 2>&1)." >&2
    echo "Name another one: make setup PYTHON=python3.12" >&2
    exit 1
fi
if [ "$(uname -sm)" != "Linux x86_64" ]; then
    echo "The wheels of ROS 2 are for Linux on x86-64, and this is $(uname -sm)." >&2
    echo "Build src/ with colcon on an installed ROS 2 Jazzy instead: see CONTRIBUTING.md." >&2
    exit 1
fi
if [ "${2-}" = view ]; then
    if ! "$python" -c 'import sys; sys.exit(sys.version_info[:2] > (3, 12))'; then
        echo "Open3D 0.19 has wheels for Python 3.10 to 3.12; '$python' is $("$python" -V 2>&1)." >&2
        echo "Leave VIEW=1 out: all but pipeprog view works without it. Or name another one: make setup PYTHON=python3.12" >&2
        exit 1
    fi
    for library in libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6 libgomp.so.1:libgomp1; do
        "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "${library%:*}" 2>/dev/null || missing="$missing ${library#*:}"
    done
    # Mesa's software renderer, which a picture without a graphics card takes.
    "$python" -c 'import ctypes; ctypes.CDLL("libEGL_mesa.so.0")' 2>/dev/null || missing="$missing libegl-mesa0 libgl1-mesa-dri"
    if [ -n "$missing" ]; then
        echo "To draw with Open3D, this machine lacks:$missing" >&2
        echo "Debian, Ubuntu: apt-get install$missing" >&2
        exit 1
    fi
    exit 0
fi
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" -c 'import venv, ensurepip' 2>/dev/null || missing="$missing python$version-venv"
"$python" -c 'import os, sys, sysconfig; sys.exit(not os.path.isfile(os.path.join(sysconfig.get_path("include"), "Python.h")))' ||
    missing="$missing python$version-dev"
command -v c++ >/dev/null && command -v cc >/dev/null || missing="$missing g++"
if [ -n "$missing" ]; then
    echo "To build the ROS 2 messages, this machine lacks:$missing" >&2
    echo "Debian, Ubuntu: apt-get install$missing" >&2
    exit 1
fi
