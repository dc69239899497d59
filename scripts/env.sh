# Source this file (bash) for a shell in which rostopic, rosservice, rosrun and roslaunch know the
# package: `source scripts/env.sh`. ROS is bound to this machine alone unless ROS_MASTER_URI or
# ROS_IP/ROS_HOSTNAME say otherwise.
IWGNET_ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
export IWGNET_ROOT
_iwgnet_devel="$IWGNET_ROOT/.build/devel"
_iwgnet_prepend() {  # variable, entry: prepends once
  case ":${!1:-}:" in *":$2:"*) ;; *) export "$1=$2${!1:+:${!1}}" ;; esac
}
_iwgnet_prepend PATH "$IWGNET_ROOT/.venv/bin"
_iwgnet_prepend CMAKE_PREFIX_PATH "$_iwgnet_devel"
_iwgnet_prepend PYTHONPATH "$_iwgnet_devel/lib/python3/dist-packages"
_iwgnet_prepend LD_LIBRARY_PATH "$_iwgnet_devel/lib"
_iwgnet_prepend ROS_PACKAGE_PATH "/usr/share"
_iwgnet_prepend ROS_PACKAGE_PATH "$IWGNET_ROOT/interfaces"
_iwgnet_prepend ROS_PACKAGE_PATH "$IWGNET_ROOT"
export ROS_MASTER_URI="${ROS_MASTER_URI:-http://127.0.0.1:11311}"
if [ -z "${ROS_IP:-}${ROS_HOSTNAME:-}" ]; then export ROS_IP=127.0.0.1; fi
export PYTHONUNBUFFERED=1  # what is said comes when it is said, in pipes and logs, too
export ROS_PYTHON_VERSION=3 ROS_DISTRO="${ROS_DISTRO:-debian}"
unset -f _iwgnet_prepend
unset _iwgnet_devel
