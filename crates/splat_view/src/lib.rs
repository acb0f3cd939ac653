//! `splat-view` shows Gaussian splats in a window, or draws pictures of them without one.
//!
//! A library, so that the program and the Python package have the same viewer.

mod arguments;
mod blending;
mod camera_path;
mod capture;
mod checkpoint;
mod composing;
mod detail;
mod display;
mod drawing_choice;
mod gestures;
mod headless;
mod loader;
mod model;
mod notes;
mod overlay;
mod painter;
mod panel;
mod photo;
mod picture_files;
mod pipelines;
mod rasterizing;
mod saving;
mod scene_changes;
mod scene_view;
mod screen;
mod session;
mod sources;
mod stage_times;
mod start;
mod streaming;
mod surroundings;
mod up_axis;
mod viewer;
mod viewpoint;
mod window;

use std::ffi::OsString;

use arguments::{Arguments, Asked, HELP};
use splat_render::Result;

/// Runs a command line without the program's name; prints errors and returns the exit status. Only the
/// process's first thread may open a window.
pub fn run(words: impl IntoIterator<Item = OsString>) -> u8 {
    match asked(words) {
        Ok(()) => 0,
        Err(error) => {
            let message = error.to_string();
            print_line(&format!("{}.", message.trim_end_matches('.')));
            1
        }
    }
}

/// Prints a line to stderr. Terminal codes, which files and their names may hold, are escaped.
fn print_line(text: &str) {
    let is_code = |c: char| {
        c.is_control()
            || matches!(c, '\u{200e}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    let escaped = |c: char| if is_code(c) { c.escape_default().to_string() } else { c.to_string() };
    eprintln!("{}", text.chars().map(escaped).collect::<String>());
}

fn asked(words: impl IntoIterator<Item = OsString>) -> Result<()> {
    match Arguments::parse(words)? {
        Asked::Help => println!("{HELP}"),
        Asked::Version => println!("splat-view {}", env!("CARGO_PKG_VERSION")),
        Asked::Run(arguments) if arguments.is_headless() => headless::run(&arguments)?,
        Asked::Run(arguments) => window::run(*arguments)?,
    }
    Ok(())
}
