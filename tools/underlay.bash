# SPDX-License-Identifier: Apache-2.0
# Sourced by setup.bash and bootstrap.sh with $root set: activates .venv and the ROS 2 below the checkout's own packages.

prepend() {  # prepend VARIABLE PATH: put PATH first in the colon-separated VARIABLE, once
  case ":${!1:-}:" in
    *":$2:"*) ;;
    *) export "$1=$2${!1:+:${!1}}" ;;
  esac
}

export VIRTUAL_ENV="$root/.venv"
prepend PATH "$root/.venv/bin"

if [ "$(<"$root/.venv/underlay")" = wheels ]; then
  # The wheels' start-up hook runs Python a second time to set the library path; here it is set beforehand.
  for libraries in "$root"/.venv/lib/python3*/site-packages/ros_*.libs "$root/.venv/lib"; do
    prepend LD_LIBRARY_PATH "$libraries"
  done
  unset libraries
  export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
  prepend AMENT_PREFIX_PATH "$root/.venv"
  prepend CMAKE_PREFIX_PATH "$root/.venv"
fi
