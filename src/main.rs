//! The program `rosrescue`.

use std::process::ExitCode;

fn main() -> ExitCode {
    rosrescue::program::main()
}
