//! The state of the window: models, view, capture, settings.

use std::path::{Path, PathBuf};

use glam::DVec3;
use splat_render::{Camera, Result};

use crate::blending::Drawable;
use crate::camera_path::{CameraPath, Recording};
use crate::capture::CaptureCamera;
use crate::display::Settings;
use crate::model::Model;
use crate::notes::Notes;
use crate::painter::{Painter, Shot};
use crate::sources::{Source, Stamp, label};
use crate::streaming::Streaming;
use crate::viewpoint::{Viewpoint, fitted};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Moving {
    /// Drags orbit about a point.
    #[default]
    Orbit,
    /// Drags look around, keys move along the viewing direction.
    Fly,
    /// Drags look around, keys move horizontally.
    FirstPerson,
}

impl Moving {
    pub const ALL: [(Self, &str); 3] =
        [(Self::Orbit, "Orbit"), (Self::Fly, "Fly"), (Self::FirstPerson, "First person")];
}

#[derive(Debug)]
pub struct Shown {
    pub path: PathBuf,
    /// The file's stamp when it was read.
    pub stamp: Option<Stamp>,
    /// The model in memory: for its extent, and for files with depth.
    pub model: Model,
    pub drawable: Drawable,
    /// Streams splats of a scene in levels of detail.
    pub streaming: Option<Streaming>,
}

/// Requests of the panel, keys and gestures to the session.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Show a source on a side; None removes the right side.
    Choose(usize, Option<usize>),
    /// Fit the whole scene in the picture.
    Frame,
    /// Move the view to a camera of the capture.
    Jump(usize),
    /// Move the pivot of orbits to the surface at a pixel.
    Focus([u32; 2]),
    Screenshot,
    /// Save the render with alpha and depth.
    SaveExr,
    /// Draw the path's pictures to files.
    Record,
    StopRecording,
}

#[derive(Debug)]
pub struct Viewer {
    pub sources: Vec<Source>,
    /// A folder whose models come and change.
    pub folder: Option<PathBuf>,
    /// The files chosen for the left and the right side.
    pub chosen: [Option<PathBuf>; 2],
    pub shown: [Option<Shown>; 2],
    /// Start of the right side, as a fraction of the width.
    pub divider: f32,
    pub holds_divider: bool,
    pub settings: Settings,
    pub viewpoint: Viewpoint,
    /// Whether a model or a camera has set `viewpoint`.
    pub is_placed: bool,
    /// The up axis, a unit vector.
    pub up: DVec3,
    pub moving: Moving,
    pub cameras: Vec<CaptureCamera>,
    /// The camera that the view is at.
    pub at_camera: Option<usize>,
    /// Whether they are drawn.
    pub shows_cameras: bool,
    /// Opacity of the photo over the picture from its camera, 0 to 1.
    pub photo_strength: f32,
    pub path: CameraPath,
    /// Pictures from each place to the next.
    pub pictures_between: u32,
    pub recording: Option<Recording>,
    pub notes: Notes,
    pub shows_panel: bool,
    pub device: String,
    /// Milliseconds from the start of a frame until it is shown.
    pub frame_ms: f32,
}

impl Viewer {
    pub fn new(settings: Settings, device: String) -> Self {
        Self {
            sources: Vec::new(),
            folder: None,
            chosen: [None, None],
            shown: [None, None],
            divider: 0.5,
            holds_divider: false,
            settings,
            viewpoint: Viewpoint::framing(DVec3::ZERO, 1.0, DVec3::NEG_Y, settings.fov),
            is_placed: false,
            up: DVec3::NEG_Y,
            moving: Moving::default(),
            cameras: Vec::new(),
            at_camera: None,
            shows_cameras: false,
            photo_strength: 0.0,
            path: CameraPath::default(),
            pictures_between: 30,
            recording: None,
            notes: Notes::default(),
            shows_panel: true,
            device,
            frame_ms: 0.0,
        }
    }

    /// Center and radius of the scene.
    pub fn extent(&self) -> (DVec3, f64) {
        let shown = self.shown.iter().flatten().next();
        shown.map_or((DVec3::ZERO, 1.0), |shown| (shown.model.center, shown.model.radius))
    }

    /// The camera of a picture of a size: the capture's own if the view is at one.
    pub fn camera(&self, size: [u32; 2]) -> Camera {
        match self.at_camera.and_then(|i| self.cameras.get(i)) {
            Some(at) => fitted(&at.camera, size),
            None => self.viewpoint.camera(size, self.settings.fov),
        }
    }

    /// Moves the view to a camera of the capture.
    pub fn jump(&mut self, number: usize) {
        let Some(at) = self.cameras.get(number) else { return };
        let (center, radius) = self.extent();
        self.viewpoint = Viewpoint::of_camera(&at.camera, center, radius);
        self.at_camera = Some(number);
        self.notes.tell_state(format!("Camera {number}: {}", at.name));
    }

    /// Leaves the capture's camera and keeps its field of view.
    pub fn leave_camera(&mut self, size: [u32; 2]) {
        if self.at_camera.is_some() {
            let camera = self.camera(size);
            self.settings.fov = 2.0 * (0.5 * f64::from(size[1]) / camera.fy).atan();
            self.at_camera = None;
        }
    }

    pub fn frame(&mut self) {
        let (center, radius) = self.extent();
        self.viewpoint = Viewpoint::framing(center, radius, self.up, self.settings.fov);
    }

    /// The content of a frame of a size.
    pub fn shot(&self, size: [u32; 2]) -> Shot<'_> {
        let drawable = |side: usize| self.shown[side].as_ref().map(|shown| &shown.drawable);
        let camera = self.camera(size);
        let (center, radius) = self.extent();
        let middle = camera.viewmat.transform_point3(center).z;
        let near = (middle - 2.0 * radius).max(f64::from(self.settings.near));
        Shot {
            camera,
            settings: &self.settings,
            left: drawable(0),
            right: drawable(1),
            divider: self.divider,
            depths: [near as f32, (middle + 2.0 * radius).max(near * 2.0) as f32],
        }
    }

    /// Moves the pivot of orbits to the surface at a pixel; false if the pixel is empty.
    pub fn focus(
        &mut self,
        painter: &mut Painter,
        size: [u32; 2],
        pixel: [u32; 2],
    ) -> Result<bool> {
        let shot = self.shot(size);
        let camera = shot.camera;
        let Some(depth) = painter.depth_at(&shot, pixel)? else { return Ok(false) };
        let [x, y] = pixel.map(|p| f64::from(p) + 0.5);
        let ray = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0);
        let target = camera.viewmat.inverse().transform_point3(ray * depth);
        self.leave_camera(size);
        self.viewpoint.focus(target);
        Ok(true)
    }

    /// A side's source, by its number in the list.
    pub fn number_of(&self, side: usize) -> Option<usize> {
        let chosen = self.chosen[side].as_deref()?;
        self.sources.iter().position(|source| source.path == chosen)
    }

    /// Display name of a file.
    pub fn name_of(&self, path: &Path) -> String {
        let found = self.sources.iter().find(|source| source.path == path);
        found.map_or_else(|| path.display().to_string(), |source| label(source, &self.sources))
    }

    pub fn compares(&self) -> bool {
        self.shown[1].is_some()
    }
}
