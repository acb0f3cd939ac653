//! Models and cameras of a session: shown at the start, chosen, changed on disk, dropped on the window.

use std::path::{Path, PathBuf};

use splat_render::Result;
use splat_render::extent::near_plane;

use crate::detail::view;
use crate::loader::Loaded;
use crate::scene_view::{background, cameras_of, first_camera, first_view, up};
use crate::session::{Session, Wake};
use crate::sources::{Source, find_sources, stamp};
use crate::start::Start;
use crate::streaming::Streaming;
use crate::viewer::Shown;

impl Session {
    /// Shows the scene that was read before the window opened, from the command line's view.
    pub fn begin(&mut self, start: Start) -> Result<()> {
        self.viewer.sources = start.sources;
        self.viewer.folder = start.folder;
        let scene = self.arguments.scenes.first().cloned();
        let (cameras, note) = cameras_of(self.arguments.cameras.as_deref(), scene.as_deref())?;
        self.viewer.settings.background = background(&self.arguments, scene.as_deref());
        let first = first_camera(&self.arguments, &cameras)?;
        self.viewer.cameras = cameras;
        self.viewer.notes.show(note.unwrap_or_default());
        for (side, (source, model)) in start.models.into_iter().enumerate() {
            self.viewer.chosen[side] = Some(source.path.clone());
            let stamp = stamp(&source.path);
            self.show(Loaded { side, path: source.path, stamp, model: Ok(model) });
        }
        if let Some(number) = first {
            self.viewer.jump(number);
        }
        if let Some(degrees) = self.arguments.orbit {
            self.viewer.leave_camera(self.screen.size());
            self.viewer.viewpoint.orbit(degrees.to_radians(), 0.0, self.viewer.up);
        }
        Ok(())
    }

    /// Shows a loaded model on its side. If it could not be read, the old model stays.
    fn show(&mut self, loaded: Loaded) {
        let Loaded { side, path, stamp, model } = loaded;
        let viewer = &mut self.viewer;
        let drawable = model.and_then(|model| Ok((self.painter.upload(&model.file)?, model)));
        let (drawable, mut model) = match drawable {
            Ok(both) => both,
            Err(error) => {
                viewer.notes.show(error.to_string());
                return;
            }
        };
        for note in &model.notes {
            viewer.notes.show(note);
        }
        if let Some((_, cameras)) = self.dropped.take_if(|(dropped, _)| *dropped == path) {
            // A dropped scene replaces the cameras, too, unless it is compared and has none.
            viewer.is_placed &= viewer.compares();
            if !viewer.compares() || !cameras.is_empty() {
                viewer.up = up(&self.arguments, &cameras, &model);
                viewer.cameras = cameras;
                viewer.at_camera = None;
                self.photo = None;
            }
            if !viewer.compares() {
                viewer.settings.background = background(&self.arguments, Some(&path));
            }
        }
        if !viewer.is_placed {
            viewer.up = up(&self.arguments, &viewer.cameras, &model);
            viewer.viewpoint = first_view(&model, &viewer.cameras, viewer.up, viewer.settings.fov);
            viewer.is_placed = true;
            if self.arguments.near.is_none() {
                viewer.settings.near = near_plane(model.radius);
            }
        }
        let streaming = model.detail.take().map(|detail| {
            let proxy = self.proxy.clone();
            Streaming::start(detail, move || {
                // The window may have been closed meanwhile.
                let _ = proxy.send_event(Wake);
            })
        });
        viewer.shown[side] = Some(Shown { path, stamp, model, drawable, streaming });
        self.screen.window.request_redraw();
    }

    /// Sends the camera to scenes in levels of detail.
    pub fn follow(&mut self) {
        let size = self.screen.size();
        let seen = view(&self.viewer.camera(size), self.viewer.settings.near);
        for shown in self.viewer.shown.iter_mut().flatten() {
            if let Some(streaming) = &mut shown.streaming {
                streaming.look(seen);
            }
        }
    }

    /// Draws newly loaded parts of scenes in levels of detail.
    fn receive_details(&mut self) {
        let viewer = &mut self.viewer;
        for shown in viewer.shown.iter_mut().flatten() {
            while let Some(drawn) = shown.streaming.as_mut().and_then(Streaming::next) {
                let drawn = drawn.and_then(|d| Ok((self.painter.upload(&d.file)?, d.file)));
                match drawn {
                    Ok((drawable, file)) => {
                        shown.drawable = drawable;
                        shown.model.file = file;
                    }
                    Err(error) => viewer.notes.show(error.to_string()),
                }
                self.screen.window.request_redraw();
            }
        }
    }

    pub fn receive(&mut self) {
        self.receive_details();
        while let Some(loaded) = self.loader.next() {
            self.show(loaded);
            // Also to show why a model cannot be read.
            self.screen.window.request_redraw();
        }
    }

    fn load(&mut self, side: usize, path: &Path) {
        let proxy = self.proxy.clone();
        self.loader.load(side, path, move || {
            // The window may have been closed meanwhile.
            let _ = proxy.send_event(Wake);
        });
    }

    pub fn choose(&mut self, side: usize, path: Option<PathBuf>) {
        self.viewer.chosen[side].clone_from(&path);
        match path {
            Some(path) => self.load(side, &path),
            None => {
                // Nor a model that is still being read for it.
                self.loader.forget(side);
                self.viewer.shown[side] = None;
            }
        }
    }

    /// Looks for models that are new or have changed.
    pub fn poll_files(&mut self) {
        if let Some(folder) = &self.viewer.folder {
            // While a folder is empty, keep the old list.
            if let Ok(found) = find_sources(folder) {
                let other = |s: &Source| !s.path.starts_with(folder);
                let kept = self.viewer.sources.iter().filter(|s| other(s)).cloned();
                let sources: Vec<_> = found.into_iter().chain(kept).collect();
                if sources != self.viewer.sources {
                    self.viewer.sources = sources;
                    self.screen.window.request_redraw();
                }
            }
        }
        for side in 0..2 {
            let Some(shown) = &self.viewer.shown[side] else { continue };
            let now = stamp(&shown.path);
            // While a file is being replaced it may be gone for a moment.
            if now.is_some() && now != shown.stamp && !self.loader.is_busy(side) {
                let path = shown.path.clone();
                self.load(side, &path);
            }
        }
    }

    /// Shows a file or folder that was dropped on the window.
    pub fn dropped(&mut self, path: &Path) {
        match find_sources(path) {
            Ok(found) => {
                if path.is_dir() {
                    self.viewer.folder = Some(path.to_owned());
                }
                let first = found[0].path.clone();
                self.viewer.sources.retain(|s| !found.contains(s));
                self.viewer.sources.splice(0..0, found);
                let cameras = cameras_of(self.arguments.cameras.as_deref(), Some(path));
                let (cameras, _) = cameras.unwrap_or_default();
                self.dropped = Some((first.clone(), cameras));
                self.choose(0, Some(first));
            }
            Err(error) => self.viewer.notes.show(error.to_string()),
        }
        self.screen.window.request_redraw();
    }
}
