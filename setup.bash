# Source this in bash (`. ./setup.bash`) after `make env`: the nodes then start by name, as in `cantilever --help`.
# It stands on the ROS 2 that `make env` built on: a sourced Jazzy, or the wheels in .venv.

_root=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

if [ ! -f "$_root/install/underlay" ]; then
  echo "setup.bash: nothing built in $_root yet: run 'make env' there first" >&2
  unset _root
  return 1
fi

_prepend() {  # _prepend VARIABLE PATH: put PATH first in the colon-separated VARIABLE, once
  case ":${!1}:" in
    *":$2:"*) ;;
    *) export "$1=$2${!1:+:${!1}}" ;;
  esac
}

if [ "$(cat "$_root/install/underlay")" = wheels ]; then
  # The wheels' start-up hook executes Python a second time to set the library path; here it is set beforehand.
  for _libraries in "$_root"/.venv/lib/python3*/site-packages/ros_*.libs "$_root/.venv/lib"; do
    _prepend LD_LIBRARY_PATH "$_libraries"
  done
  export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
  _prepend AMENT_PREFIX_PATH "$_root/.venv"
  _prepend CMAKE_PREFIX_PATH "$_root/.venv"
elif [ "${ROS_DISTRO:-}" != jazzy ]; then
  echo "setup.bash: built on ROS 2 Jazzy: source it first, or run 'make env' again to build on the wheels" >&2
  unset _root
  return 1
fi

export VIRTUAL_ENV="$_root/.venv"
_prepend PATH "$_root/.venv/bin"
. "$_root/install/local_setup.bash"
_prepend PATH "$_root/install/piezo_gripper/lib/piezo_gripper"

unset _root _libraries
unset -f _prepend
