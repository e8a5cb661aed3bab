# Installs Chromium for the tests of the page, if it is missing. To be sourced after tests/install_ros.sh.

has_chromium() {
    command -v chromium || command -v chromium-headless-shell || command -v google-chrome
}

# shellcheck disable=SC2046 # splitting is intended
install_missing $(need chromium has_chromium)
