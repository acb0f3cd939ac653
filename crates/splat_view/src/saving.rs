//! Files saved from the window: screenshots, EXR files, and the pictures of a camera path.

use std::path::{Path, PathBuf};

use splat_render::gpu::Gpu;
use splat_render::{ProjectOptions, Result, Stages};

use crate::camera_path::Recording;
use crate::painter::Painter;
use crate::picture_files::{without_alpha, write_exr, write_png};
use crate::viewer::Viewer;
use crate::viewpoint::relative_to;

/// Saves the picture as PNG, without panel and cameras.
pub fn screenshot(viewer: &mut Viewer, painter: &mut Painter, size: [u32; 2]) -> Result<()> {
    let rgba = painter.picture(&viewer.shot(size))?;
    let path = free_name("splat-view", ".png");
    let written = write_png(&path, size, &without_alpha(&rgba));
    viewer.notes.show(saved(&path, written));
    Ok(())
}

/// Saves the left model as the renderer's rasterizer draws it, with alpha and depth.
pub fn exr(viewer: &mut Viewer, gpu: &Gpu, size: [u32; 2]) {
    let Some(shown) = &viewer.shown[0] else { return };
    let file = &shown.model.file;
    let settings = &viewer.settings;
    let options = ProjectOptions {
        near: settings.near,
        antialiased: file.antialiased,
        ..ProjectOptions::default()
    };
    let camera = relative_to(viewer.camera(size), file.origin);
    let image = gpu
        .project(&file.splats.params(settings.sh_degree), &camera, &options)
        .and_then(|projected| gpu.rasterize(&projected, settings.background));
    let path = free_name("splat-view", ".exr");
    let written = image.and_then(|image| write_exr(&path, &image));
    viewer.notes.show(saved(&path, written));
}

/// Begins to record the camera path through the marked places.
pub fn start_recording(viewer: &mut Viewer) {
    if viewer.path.keys.len() < 2 {
        viewer.notes.show("Mark at least two places with K, then record.");
        return;
    }
    let folder = free_name("splat-view-path", "");
    match std::fs::create_dir(&folder) {
        Ok(()) => {
            let recording = Recording::new(&viewer.path, viewer.pictures_between, folder);
            viewer.recording = Some(recording);
        }
        Err(error) => {
            viewer.notes.show(format!("{}: cannot be created ({error})", folder.display()));
        }
    }
}

/// Draws and saves the recording's next picture. An error ends the recording.
pub fn record_picture(viewer: &mut Viewer, painter: &mut Painter, size: [u32; 2]) -> Result<()> {
    let Some(mut recording) = viewer.recording.take() else { return Ok(()) };
    let Some(place) = recording.place() else { return Ok(()) };
    viewer.leave_camera(size);
    viewer.viewpoint = place;
    let path = recording.folder.join(format!("{:04}.png", recording.next));
    let rgba = painter.picture(&viewer.shot(size))?;
    write_png(&path, size, &without_alpha(&rgba))?;
    recording.next += 1;
    let total = recording.total();
    if recording.next < total {
        viewer.recording = Some(recording);
    } else {
        let folder = recording.folder.display();
        viewer.notes.show(format!("Saved {total} pictures in {folder}"));
    }
    Ok(())
}

/// The first numbered name that no file has, in the folder that the program was started in.
fn free_name(stem: &str, ending: &str) -> PathBuf {
    let name = |number: u32| PathBuf::from(format!("{stem}-{number:03}{ending}"));
    (1..).map(name).find(|path| !path.exists()).unwrap_or_else(|| name(0))
}

fn saved(path: &Path, written: Result<()>) -> String {
    written.map_or_else(|error| error.to_string(), |()| format!("Saved {}", path.display()))
}
