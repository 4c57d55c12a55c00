# SPDX-License-Identifier: Apache-2.0
# Source this in bash after `make env` (`. ./setup.bash`): the nodes then start by name, as in `cantilever --help`.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

if [ ! -f "$root/install/sources" ]; then
  echo "setup.bash: nothing is built in $root yet: run 'make env' there first" >&2
  unset root
  return 1
fi
if [ "$(<"$root/.venv/underlay")" = jazzy ] && [ "${ROS_DISTRO:-}" != jazzy ]; then
  echo "setup.bash: built on ROS 2 Jazzy: source it first, or run 'make env' again to build on the wheels" >&2
  unset root
  return 1
fi

. "$root/tools/underlay.bash"
. "$root/install/local_setup.bash"
prepend PATH "$root/install/piezo_gripper/lib/piezo_gripper"
export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$root/params/discovery.xml}"

unset root
unset -f prepend
