# Builds the workspace into the virtual environment, where ROS 2 itself lies. Usage: build.sh VENV
set -eu
venv=$(cd "$1" && pwd -P)
python=$venv/bin/python
packages=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')

cp setup/pipeprog_start.py "$packages/"
# .pth files are read in the order of their names: this one before that of the wheels (ros_...).
echo 'import pipeprog_start' >"$packages/pipeprog_start.pth"

echo "Building the workspace ..."
export PATH="$venv/bin:$PATH" CMAKE_PREFIX_PATH="$venv" AMENT_PREFIX_PATH="$venv" CMAKE_GENERATOR=Ninja
if ! "$python" -m colcon --log-base "$venv/log" build \
    --base-paths src setup --build-base "$venv/build" --install-base "$venv" --merge-install \
    --event-handlers console_direct- console_cohesion- summary+ \
    --cmake-args -DPython3_EXECUTABLE="$python" -DPYTHON_EXECUTABLE="$python" -DBUILD_TESTING=OFF \
    >"$venv/build.log" 2>&1; then
    cat "$venv/build.log" >&2
    echo "The workspace did not build; the log of each package is in $venv/log/latest_build." >&2
    exit 1
fi
# Not the script of the package's entry point: its first line cannot hold a path with a space.
rm -f "$venv/bin/pipeprog"
cat >"$venv/bin/pipeprog" <<'END'
#!/bin/sh
here=$(dirname -- "$(readlink -f -- "$0")")
exec "$here/python" -c 'import sys; sys.argv[0] = "pipeprog"; from pipeprog_bringup.cli import main; main()' "$@"
END
chmod +x "$venv/bin/pipeprog"
