# Checks of NAME:=VALUE arguments for the start scripts; source it. A bad argument ends the script
# with one line on stderr and status 2.
bad_arguments() { echo "$(basename "$0"): $*" >&2; exit 2; }

one_of() {  # name, value, allowed values...
  local name="$1" value="$2" allowed; shift 2
  for allowed in "$@"; do [ "$value" != "$allowed" ] || return 0; done
  bad_arguments "$name: '$value' is not one of: $*"
}

whole_number() {  # name, value
  [[ "$2" =~ ^[0-9]{1,9}$ ]] || bad_arguments "$1: '$2' is not a whole number from 0 to 999999999"
}

readable_file() {  # name, value
  [ -f "$2" ] && [ -r "$2" ] || bad_arguments "$1: no readable file '$2'"
}

scene_names() {  # package folder: the keys at the left margin, on one line
  sed -n 's/^\([A-Za-z0-9_]\+\):.*/\1/p' "$1/config/scenes.yaml" | paste -sd' '
}
