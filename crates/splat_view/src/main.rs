//! The program `splat-view`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(splat_view::run(std::env::args_os().skip(1)))
}
