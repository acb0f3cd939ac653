//! `splat-view`: splats in a window or as pictures.

mod arguments;
mod blending;
mod camera_path;
mod capture;
mod checkpoint;
mod colmap;
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
mod scene_view;
mod sources;
mod stage_times;
mod transforms;
mod viewer;
mod viewpoint;
mod window;

use std::process::ExitCode;

use arguments::{Arguments, Asked, HELP};
use splat_render::Result;

/// Keeps Mesa's layer that asks the desktop which GPU to take from printing an error where there is no
/// desktop to ask, unless something is set for it.
fn quiet_layers() {
    let set = ["NODEVICE_SELECT", "MESA_VK_DEVICE_SELECT"];
    if set.iter().all(|name| std::env::var_os(name).is_none()) {
        // SAFETY: the program has one thread so far.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

fn run() -> Result<()> {
    match Arguments::parse(std::env::args_os().skip(1))? {
        Asked::Help => println!("{HELP}"),
        Asked::Version => println!("splat-view {}", env!("CARGO_PKG_VERSION")),
        Asked::Run(arguments) if arguments.is_headless() => {
            quiet_layers();
            headless::run(&arguments)?;
        }
        Asked::Run(arguments) => window::run(*arguments)?,
    }
    Ok(())
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let sentence = error.to_string();
            eprintln!("{}.", sentence.trim_end_matches('.'));
            ExitCode::FAILURE
        }
    }
}
