//! `splat-view` shows Gaussian splats in a window, or draws pictures of them without one.

mod arguments;
mod blending;
mod camera_path;
mod capture;
mod checkpoint;
mod composing;
mod display;
mod gestures;
mod headless;
mod loader;
mod model;
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
mod viewer;
mod viewpoint;
mod window;

use std::process::ExitCode;

use arguments::{Arguments, Asked, HELP};
use splat_render::Result;

fn run() -> Result<()> {
    match Arguments::parse(std::env::args_os().skip(1))? {
        Asked::Help => println!("{HELP}"),
        Asked::Version => println!("splat-view {}", env!("CARGO_PKG_VERSION")),
        Asked::Run(arguments) if arguments.is_headless() => headless::run(&arguments)?,
        Asked::Run(arguments) => window::run(*arguments)?,
    }
    Ok(())
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let message = error.to_string();
            eprintln!("{}.", message.trim_end_matches('.'));
            ExitCode::FAILURE
        }
    }
}
