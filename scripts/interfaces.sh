#!/usr/bin/env bash
# Builds the interface packages that are not among the ROS 2 wheels of a virtual environment, into it.
# Usage: interfaces.sh VENV
set -euo pipefail

venv=$(cd "$1" && pwd)
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
# As ROS 2 Jazzy has it: with any other hash no ROS 2 node would see our transforms.
expected=RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087
description=$venv/share/tf2_msgs/msg/TFMessage.json

build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT

# The wheels' exported targets name include folders of the machine they were built on; CMake refuses targets
# whose folders do not exist, and the folders that do are passed in by the Python3 module.
{ grep -rlZ '/opt/python/' "$venv/share" --include='*.cmake' || true; } |
    xargs -r0 sed -i -E 's#;?/opt/python/[^;"]*##g'

# A clean environment: flags and prefixes of the caller's shell would end up in the message's libraries.
if ! env -i HOME="$HOME" PATH="$venv/bin:/usr/local/bin:/usr/bin:/bin" ${LANG:+LANG="$LANG"} \
    AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv" \
    "$venv/bin/colcon" --log-base "$build/log" build \
    --base-paths "$here/interfaces" --build-base "$build/build" \
    --install-base "$venv" --merge-install \
    --cmake-args -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release \
    -DPython3_EXECUTABLE="$venv/bin/python" -DPython3_ROOT_DIR="$venv" >"$build/output" 2>&1; then
    cat "$build/output" >&2
    exit 1
fi

found=$(grep -m 1 -o 'RIHS01_[0-9a-f]*' "$description" || true)
if [ "$found" != "$expected" ]; then
    echo "tf2_msgs/TFMessage has type hash ${found:-none}, ROS 2 has $expected" >&2
    exit 1
fi
"$venv/bin/python" -c '
from point_cloud_interfaces.msg import CompressedPointCloud2
from tf2_msgs.msg import TFMessage

TFMessage.__class__.__import_type_support__()
CompressedPointCloud2.__class__.__import_type_support__()'
