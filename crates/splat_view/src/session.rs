//! The event loop of an open window: frames and user actions.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use egui::{CentralPanel, Panel, Sense, TextureHandle};
use splat_render::Result;
use winit::event_loop::EventLoopProxy;

use crate::arguments::Arguments;
use crate::capture::CaptureCamera;
use crate::display::{Drawing, Settings};
use crate::loader::Loader;
use crate::painter::{Painter, side_max};
use crate::photo::read_photo;
use crate::screen::{Interface, Screen};
use crate::stage_times::{PANEL, STAGES, Written};
use crate::viewer::{Action, Viewer};
use crate::{gestures, overlay, panel, saving};

/// How often files are checked for changes.
const POLL: Duration = Duration::from_millis(500);
const PANEL_WIDTH: f32 = 250.0;

/// Another thread has something ready.
#[derive(Debug, Clone, Copy)]
pub struct Wake;

/// An open window and all that lives with it. `scene_changes` has the part that loads models.
pub struct Session {
    pub screen: Screen,
    pub painter: Painter,
    pub viewer: Viewer,
    pub loader: Loader,
    pub proxy: EventLoopProxy<Wake>,
    pub arguments: Arguments,
    /// The photo of a camera, by the camera's number.
    pub photo: Option<(usize, TextureHandle)>,
    /// The file of a scene that was dropped and is not shown yet, and the cameras found with it.
    pub dropped: Option<(PathBuf, Vec<CaptureCamera>)>,
    /// When files were last checked for changes.
    polled: Instant,
    /// When to draw again if nothing happens before.
    due: Option<Instant>,
}

impl Session {
    pub fn new(screen: Screen, arguments: Arguments, proxy: EventLoopProxy<Wake>) -> Result<Self> {
        let painter = Painter::new(Arc::clone(&screen.gpu), screen.format())?;
        let mut settings = Settings::default();
        settings.near = arguments.near.unwrap_or(settings.near);
        settings.drawing = arguments.drawing;
        settings.fov = arguments.fov.map_or(settings.fov, f64::to_radians);
        Ok(Self {
            viewer: Viewer::new(settings, screen.gpu.name()),
            painter,
            loader: Loader::new(arguments.budget),
            proxy,
            arguments,
            photo: None,
            dropped: None,
            polled: Instant::now(),
            due: None,
            screen,
        })
    }

    /// Checks files and the time of the next frame; when to do so again.
    pub fn idle(&mut self, now: Instant) -> Instant {
        if now.duration_since(self.polled) >= POLL {
            self.polled = now;
            self.poll_files();
            if self.painter.is_short() {
                self.screen.window.request_redraw();
            }
        }
        if self.due.is_some_and(|due| due <= now) {
            self.due = None;
            self.screen.window.request_redraw();
        }
        let next = self.polled + POLL;
        self.due.map_or(next, |due| due.min(next))
    }

    /// Runs the panel and the gestures, handles their actions, and draws.
    pub fn frame(&mut self) -> Result<()> {
        let started = Instant::now();
        let times = self.painter.times.latest();
        let mut actions = Vec::new();
        let interface = self.run_ui(times, &mut actions);
        for action in actions {
            let done = self.act(action);
            self.say(done)?;
        }
        self.load_photo();
        self.follow();
        self.due = interface.repaint_delay.and_then(|delay| started.checked_add(delay));
        self.draw(interface)?;
        if self.viewer.recording.is_some() {
            let size = self.screen.size();
            let done = saving::record_picture(&mut self.viewer, &mut self.painter, size);
            self.say(done)?;
            self.screen.window.request_redraw();
        }
        // The next frame reads the times of this one.
        if times.is_none() && self.painter.times.are_pending() {
            self.due = Some(self.due.map_or(started + POLL, |due| due.min(started + POLL)));
        }
        self.viewer.frame_ms = started.elapsed().as_secs_f32() * 1e3;
        Ok(())
    }

    fn run_ui(
        &mut self,
        times: Option<[f32; STAGES.len()]>,
        actions: &mut Vec<Action>,
    ) -> Interface {
        let size = self.screen.size();
        let (viewer, photo) = (&mut self.viewer, &self.photo);
        self.screen.run_ui(|ui| {
            if viewer.shows_panel {
                Panel::right("panel").exact_size(PANEL_WIDTH).show(ui, |ui| {
                    panel::panel(viewer, ui, times, actions);
                });
            }
            CentralPanel::no_frame().show(ui, |ui| {
                let response =
                    ui.interact(ui.max_rect(), egui::Id::unique("splats"), Sense::click_and_drag());
                if !overlay::hold_divider(viewer, ui) {
                    gestures::pointer(viewer, ui, &response, size, actions);
                }
                gestures::keys(viewer, ui, size, actions);
                let clicked = response.interact_pointer_pos().filter(|_| response.clicked());
                if let Some((_, texture)) = photo {
                    overlay::photo(viewer, ui, size, texture);
                }
                overlay::cameras(viewer, ui, size, clicked, actions);
                overlay::divider(viewer, ui);
            });
        })
    }

    fn act(&mut self, action: Action) -> Result<()> {
        let size = self.screen.size();
        let viewer = &mut self.viewer;
        match action {
            Action::Choose(side, number) => {
                let path = number.and_then(|i| viewer.sources.get(i)).map(|s| s.path.clone());
                self.choose(side, path);
            }
            Action::Frame => {
                viewer.leave_camera(size);
                viewer.frame();
            }
            Action::Jump(number) => viewer.jump(number),
            Action::Focus(pixel) => {
                if !viewer.focus(&mut self.painter, size, pixel)? {
                    viewer.notes.show("There is nothing at this point.");
                }
            }
            Action::Screenshot => saving::screenshot(viewer, &mut self.painter, size)?,
            Action::SaveExr => saving::exr(viewer, &self.screen.gpu, size),
            Action::Record => saving::start_recording(viewer),
            Action::StopRecording => viewer.recording = None,
        }
        self.screen.window.request_redraw();
        Ok(())
    }

    /// Shows an error in the panel and goes on; a lost device ends the program.
    fn say(&mut self, result: Result<()>) -> Result<()> {
        match result {
            Err(error) if !self.screen.gpu.is_lost() => {
                let text = error.to_string();
                // An error of every frame is shown once.
                if !self.viewer.notes.has(&text) {
                    self.viewer.notes.show(text);
                    self.screen.window.request_redraw();
                }
                Ok(())
            }
            result => result,
        }
    }

    fn draw(&mut self, mut interface: Interface) -> Result<()> {
        let gpu = Arc::clone(&self.screen.gpu);
        let acquired = self.screen.acquire();
        let (texture, is_stale) = match acquired {
            Ok(acquired) => acquired,
            Err(error) => {
                self.say(Err(error))?;
                (None, true)
            }
        };
        if let Some(texture) = texture {
            let target = texture.texture.create_view(&Default::default());
            let mut encoder = gpu.device().create_command_encoder(&Default::default());
            let (mut written, load) = self.record_scene(&mut encoder, &target)?;
            let stamps = self.painter.panel_stamps();
            written[PANEL] = stamps.is_some();
            let uploads = self.screen.record(&mut encoder, &mut interface, &target, load, stamps);
            self.painter.times.resolve(&mut encoder, written);
            self.screen.show(texture, uploads.into_iter().chain([encoder.finish()]));
            self.painter.times.submitted();
        }
        self.screen.finish(&interface);
        if is_stale {
            self.screen.configure()?;
            self.screen.window.request_redraw();
        }
        // Callbacks of finished work run here.
        let _ = gpu.device().poll(wgpu::PollType::Poll);
        self.say(gpu.check())
    }

    /// Records the models' picture; returns its stages, and the load operation for the panel's pass.
    fn record_scene(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        target: &wgpu::TextureView,
    ) -> Result<(Written, wgpu::LoadOp<wgpu::Color>)> {
        let size = [target.texture().width(), target.texture().height()];
        let recorded = match self.painter.record(encoder, &self.viewer.shot(size), target) {
            // The way that was asked for lacks memory here: another is taken, and the panel says why.
            Err(error) if self.viewer.settings.drawing == Drawing::Rasterizer => {
                self.viewer.notes.show(error.to_string());
                self.viewer.settings.drawing = Drawing::Auto;
                self.screen.window.request_redraw();
                self.painter.record(encoder, &self.viewer.shot(size), target)
            }
            recorded => recorded,
        };
        match recorded {
            Ok(written) => Ok((written, wgpu::LoadOp::Load)),
            // The panel alone, which says why.
            Err(error) => {
                self.say(Err(error))?;
                *encoder = self.screen.gpu.device().create_command_encoder(&Default::default());
                // Times without a beginning are an error, and recording may have failed before it.
                self.painter.times.begin(&self.screen.gpu);
                Ok(([false; STAGES.len()], wgpu::LoadOp::Clear(wgpu::Color::BLACK)))
            }
        }
    }

    /// Reads the photo of the camera that the view is at, once the photo is to be seen.
    fn load_photo(&mut self) {
        let viewer = &mut self.viewer;
        let Some(number) = viewer.at_camera.filter(|_| viewer.photo_strength > 0.0) else { return };
        if self.photo.as_ref().is_some_and(|(loaded, _)| *loaded == number) {
            return;
        }
        self.photo = None;
        let Some(path) = viewer.cameras.get(number).and_then(|c| c.photo.as_deref()) else {
            return;
        };
        match read_photo(path) {
            Ok(photo) => {
                let photo = photo.within(side_max(&self.screen.gpu) as usize);
                let image = egui::ColorImage::from_rgba_unmultiplied(photo.size, &photo.rgba);
                let texture = self.screen.egui.load_texture("photo", image, Default::default());
                self.photo = Some((number, texture));
            }
            Err(error) => {
                viewer.notes.show(error.to_string());
                viewer.photo_strength = 0.0;
            }
        }
        self.screen.window.request_redraw();
    }
}
