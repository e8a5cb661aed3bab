# Installs Chromium if there is none, for the tests of the page; to be sourced after tests/install_ros.sh.

has_chromium() {
    command -v chromium || command -v chromium-headless-shell || command -v google-chrome
}

# shellcheck disable=SC2046 # words are what is wanted
install_missing $(need chromium has_chromium)
