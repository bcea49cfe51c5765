#!/usr/bin/env bash
# Installs what only the system's package manager has: a software Vulkan driver where nothing can
# render, for the simulators, and Chromium, for the browser tests. The rest works without them, so
# what stands in the way is one line and no failure. Says nothing where nothing is missing.
#
#     scripts/system_packages.sh [vulkan] [chromium]
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'setup: %s\n' "$*" >&2; }

# Runs apt-get silently; leaves in $problem, in a line, what went wrong.
apt() {
  local output
  output=$(DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 \
    -o Acquire::http::Timeout=30 "$@" 2>&1 </dev/null) && return
  problem=$(grep -m 1 '^E: ' <<<"$output" || tail -n 1 <<<"$output")
  return 1
}

# Installs packages; what an update complains of matters only where the installation fails.
install() {
  local complaint=
  apt -o APT::Update::Error-Mode=any update || complaint=$problem
  apt install --yes --no-install-recommends "$@" && return
  problem=${complaint:-$problem}
  return 1
}

# --- Vulkan: sapien needs Mesa 24.3, or the driver of a GPU --------------------------------------

is_new() { [[ -n $1 ]] && dpkg --compare-versions "$1" ge 24.3; }

has_vulkan() {
  local state version
  read -r state version < <(
    dpkg-query -W -f '${db:Status-Status} ${Version}\n' mesa-vulkan-drivers 2>/dev/null)
  [[ ${state:-} == installed ]] && is_new "$version" && return
  [[ -x .venv/bin/python ]] && timeout 60 .venv/bin/python -m \
    robomme_interference_data.simulators.tabletop.renderer &>/dev/null
}

# Prints where apt has a release's main component from, as `file:number`; after an update.
entry_of() {
  apt-get indextargets --format '$(SOURCESENTRY)' \
    'Created-By: Packages' 'Component: main' "Origin: $1" "Codename: $2" | head -n 1
}

# Prints that entry, mirror and key included, for another suite. A .list file has an entry in each
# line, a .sources file in each paragraph.
with_suite() {
  local file=${1%:*} number=${1##*:} suite=$2
  if [[ $file == *.list ]]; then
    sed -nE "$number s/^(deb +(\[[^]]*\] +)?[^ ]+ +)[^ ]+/\1$suite/p" "$file"
  else
    sed '/^#/d' "$file" | awk -v RS= -v number="$number" 'NR == number' |
      awk -v suite="$suite" '/^[^ \t]/ { dropped = 0 }
        tolower($1) ~ /^suites:/ { print "Suites: " suite; dropped = 1 }
        !dropped'
  fi
}

# Debian 12's own Mesa is too old, that of its backports is not.
install_vulkan() {
  local suite=bookworm-backports entry folder added
  apt update
  if is_new "$(apt-cache policy mesa-vulkan-drivers | sed -n 's/^ *Candidate: //p')"; then
    install mesa-vulkan-drivers
    return
  fi
  if [[ -z $(entry_of 'Debian Backports' "$suite") ]]; then
    entry=$(entry_of Debian bookworm)
    if [[ -z $entry ]]; then problem="apt knows no Mesa of 24.3 or newer"; return 1; fi
    eval "$(apt-config shell folder Dir::Etc::sourceparts/d)"
    added=$folder$suite.${entry##*.}
    added=${added%:*}
    trap "rm -f '$added'" EXIT # what fails, or is interrupted, leaves no trace
    with_suite "$entry" "$suite" >"$added"
  fi
  install --target-release "$suite" mesa-vulkan-drivers && trap - EXIT
}

# --- Chromium ------------------------------------------------------------------------------------

has_chromium() {
  command -v chromium chromium-browser google-chrome google-chrome-stable chrome >/dev/null
}

install_chromium() { install chromium; }

# -------------------------------------------------------------------------------------------------

# Arguments: what is installed, what is missing, what to do without apt, and what without root.
provide() {
  "has_$1" && return
  if ! command -v apt-get >/dev/null; then
    say "$2: $3"
  elif [[ $(id -u) != 0 ]]; then
    say "$2: $4"
  else
    say "installing $1 ..."
    if ! "install_$1"; then
      say "$2: installing $1 failed: $problem"
    elif ! "has_$1"; then
      say "$2: the $1 that apt has will not do"
    fi
  fi
}

[[ $OSTYPE == linux* ]] || exit 0
[[ $# -gt 0 ]] || set -- vulkan chromium
for wanted in "$@"; do
  case $wanted in
    vulkan) provide vulkan "no Vulkan device can render (simulators need one)" \
      "install the driver of your GPU, or Mesa's software driver, 24.3 or newer" \
      "to install Mesa's software driver, run: sudo make vulkan" ;;
    chromium) provide chromium "no Chromium (browser tests are skipped)" \
      "install Chromium or Chrome" "run: sudo apt-get install chromium" ;;
  esac
done
exit 0
