//! The window: the event loop, the surface, and what actions do.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use egui::{CentralPanel, FullOutput, Panel, Sense, TextureHandle, ViewportId};
use splat_render::gpu::Gpu;
use splat_render::{Error, ProjectOptions, Result, Stages};
use winit::application::ApplicationHandler;
use winit::dpi::LogicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, EventLoopProxy};
use winit::window::{Window, WindowId};

use crate::arguments::Arguments;
use crate::camera_path::Recording;
use crate::capture::CaptureCamera;
use crate::display::{Drawing, Settings};
use crate::loader::{Loaded, Loader};
use crate::model::Model;
use crate::painter::{Painter, check_size, side_max};
use crate::photo::read_photo;
use crate::picture_files::{without_alpha, write_exr, write_png};
use crate::scene_view::{cameras_of, first_view, near, up};
use crate::sources::{Source, find_sources, stamp};
use crate::stage_times::{PANEL, STAGES};
use crate::viewer::{Action, Shown, Viewer};
use crate::viewpoint::relative_to;
use crate::{gestures, overlay, panel};

/// How often files are looked at for changes.
const LOOK: Duration = Duration::from_millis(500);
/// Width of the panel in points.
const PANEL_WIDTH: f32 = 250.0;

/// Something is ready that another thread has made.
#[derive(Debug, Clone, Copy)]
struct Wake;

/// Opens a window and shows what the command line names, until it is closed.
pub fn run(arguments: Arguments) -> Result<()> {
    // Before the window: what cannot be read is said where it was asked for.
    let start = Start::read(&arguments)?;
    let event_loop =
        EventLoop::<Wake>::with_user_event().build().map_err(|_| Error::Device(no_display()))?;
    let proxy = event_loop.create_proxy();
    let mut app = App { arguments, start: Some(start), proxy, open: None, failure: None };
    event_loop
        .run_app(&mut app)
        .map_err(|e| Error::Device(format!("the window failed ({}); open it again", reason(&e))))?;
    app.failure.map_or(Ok(()), Err)
}

/// Why there is no window, and what to do.
fn no_display() -> String {
    let why = if cfg!(all(unix, not(target_os = "macos"))) {
        let set = |name: &&str| {
            let value = std::env::var_os(name).filter(|value| !value.is_empty())?;
            Some(format!("{name}={}", value.display()))
        };
        let set: Vec<String> = ["WAYLAND_DISPLAY", "DISPLAY"].iter().filter_map(set).collect();
        match set.is_empty() {
            true => ": neither WAYLAND_DISPLAY nor DISPLAY is set".to_owned(),
            false => format!(" at {}", set.join(" or ")),
        }
    } else {
        String::new()
    };
    format!(
        "no display answers{why}; start splat-view on a desktop, or draw without a window: \
         --screenshot FILE"
    )
}

/// What winit says, without the file and line of its source that it begins with.
fn reason(error: &impl std::fmt::Display) -> String {
    let text = error.to_string();
    let rest = text.strip_prefix("os error at ").and_then(|text| text.split_once(": "));
    rest.map_or(text.as_str(), |(_, reason)| reason).to_owned()
}

/// What is shown first.
struct Start {
    sources: Vec<Source>,
    folder: Option<PathBuf>,
    /// For the left and the right side.
    models: Vec<(Source, Model)>,
}

impl Start {
    fn read(arguments: &Arguments) -> Result<Self> {
        let mut out = Self { sources: Vec::new(), folder: None, models: Vec::new() };
        for scene in &arguments.scenes {
            let found = find_sources(scene)?;
            if scene.is_dir() {
                out.folder.get_or_insert_with(|| scene.clone());
            }
            if out.models.len() < 2 {
                let model = Model::read(&found[0].path)?;
                out.models.push((found[0].clone(), model));
            }
            out.sources.extend(found);
        }
        Ok(out)
    }
}

struct App {
    arguments: Arguments,
    start: Option<Start>,
    proxy: EventLoopProxy<Wake>,
    open: Option<Open>,
    failure: Option<Error>,
}

/// The window and all that lives with it.
struct Open {
    window: Arc<Window>,
    surface: wgpu::Surface<'static>,
    config: wgpu::SurfaceConfiguration,
    painter: Painter,
    egui: egui::Context,
    input: egui_winit::State,
    panels: egui_wgpu::Renderer,
    viewer: Viewer,
    loader: Loader,
    proxy: EventLoopProxy<Wake>,
    arguments: Arguments,
    /// The photo of a camera.
    photo: Option<(usize, TextureHandle)>,
    /// The file of a scene that was dropped and is not shown yet, and the cameras found with it.
    dropped: Option<(PathBuf, Vec<CaptureCamera>)>,
    looked: Instant,
    /// When to draw again, if nothing happens before.
    due: Option<Instant>,
}

impl App {
    fn open(&mut self, event_loop: &ActiveEventLoop) -> Result<Open> {
        let size = match self.arguments.size {
            Some([width, height]) => winit::dpi::PhysicalSize::new(width, height).into(),
            None => winit::dpi::Size::from(LogicalSize::new(1280.0, 720.0)),
        };
        let attributes = Window::default_attributes().with_title("splat-view");
        // Seen once something can draw in it.
        let attributes = attributes.with_inner_size(size).with_visible(false);
        let failed = |what: String| Error::Device(format!("no window can be opened ({what})"));
        let window = event_loop.create_window(attributes).map_err(|e| failed(reason(&e)))?;
        let window = Arc::new(window);
        let (gpu, adapter, surface) = Gpu::for_window(Arc::clone(&window))?;
        let gpu = Arc::new(gpu);
        if let Some(size) = self.arguments.size {
            check_size(&gpu, size)?;
        }
        let most = side_max(&gpu);
        let size = window.inner_size();
        let mut config = surface
            .get_default_config(&adapter, size.width.clamp(1, most), size.height.clamp(1, most))
            .ok_or_else(|| failed(format!("{} shows nothing in it", gpu.name())))?;
        // Colours are as they are seen, and so is what egui blends.
        let formats = surface.get_capabilities(&adapter).formats;
        config.format = formats.iter().copied().find(|f| !f.is_srgb()).unwrap_or(config.format);
        config.present_mode = wgpu::PresentMode::AutoVsync;
        surface.configure(gpu.device(), &config);
        let painter = Painter::new(Arc::clone(&gpu), config.format)?;
        let egui = egui::Context::default();
        egui.set_theme(egui::Theme::Dark);
        let input = egui_winit::State::new(
            egui.clone(),
            ViewportId::ROOT,
            event_loop,
            Some(window.scale_factor() as f32),
            None,
            Some(most as usize),
        );
        let panels = egui_wgpu::Renderer::new(gpu.device(), config.format, Default::default());
        let mut settings =
            Settings { background: self.arguments.background, ..Settings::default() };
        settings.near = self.arguments.near.unwrap_or(settings.near);
        settings.drawing = self.arguments.drawing;
        settings.fov = self.arguments.fov.map_or(settings.fov, f64::to_radians);
        let mut open = Open {
            viewer: Viewer::new(settings, gpu.name()),
            window,
            surface,
            config,
            painter,
            egui,
            input,
            panels,
            loader: Loader::new(),
            proxy: self.proxy.clone(),
            arguments: self.arguments.clone(),
            photo: None,
            dropped: None,
            looked: Instant::now(),
            due: None,
        };
        if let Some(start) = self.start.take() {
            open.begin(start)?;
        }
        open.window.set_visible(true);
        open.window.request_redraw();
        Ok(open)
    }

    fn end(&mut self, event_loop: &ActiveEventLoop, result: Result<()>) {
        if let Err(error) = result {
            self.failure.get_or_insert(error);
            event_loop.exit();
        }
    }
}

impl ApplicationHandler<Wake> for App {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.open.is_none() {
            match self.open(event_loop) {
                Ok(open) => self.open = Some(open),
                Err(error) => self.end(event_loop, Err(error)),
            }
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(open) = &mut self.open else { return };
        let response = open.input.on_window_event(&open.window, &event);
        // A frame that asked for the next one would keep a window busy in which nothing moves.
        if response.repaint && event != WindowEvent::RedrawRequested {
            open.window.request_redraw();
        }
        let result = match event {
            WindowEvent::CloseRequested => {
                event_loop.exit();
                Ok(())
            }
            WindowEvent::Resized(size) => {
                // At once: a frame of the old size would be stretched.
                open.resize(size.width, size.height).and_then(|()| open.frame())
            }
            WindowEvent::DroppedFile(path) => {
                open.dropped(&path);
                Ok(())
            }
            WindowEvent::RedrawRequested => open.frame(),
            _ => Ok(()),
        };
        self.end(event_loop, result);
    }

    fn user_event(&mut self, _: &ActiveEventLoop, _: Wake) {
        let Some(open) = &mut self.open else { return };
        open.receive();
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        let Some(open) = &mut self.open else { return };
        let now = Instant::now();
        if now.duration_since(open.looked) >= LOOK {
            open.looked = now;
            open.look();
        }
        if open.due.is_some_and(|due| due <= now) {
            open.due = None;
            open.window.request_redraw();
        }
        let next = open.looked + LOOK;
        event_loop.set_control_flow(ControlFlow::WaitUntil(open.due.map_or(next, |d| d.min(next))));
    }
}

impl Open {
    /// Shows what was read before the window was there.
    fn begin(&mut self, start: Start) -> Result<()> {
        self.viewer.sources = start.sources;
        self.viewer.folder = start.folder;
        let scene = self.arguments.scenes.first().cloned();
        let (cameras, note) = cameras_of(self.arguments.cameras.as_deref(), scene.as_deref())?;
        self.viewer.up = up(&self.arguments, &cameras);
        self.viewer.cameras = cameras;
        for (side, (source, model)) in start.models.into_iter().enumerate() {
            self.viewer.chosen[side] = Some(source.path.clone());
            let stamp = stamp(&source.path);
            self.show(Loaded { side, path: source.path, stamp, model: Ok(model) });
        }
        if let Some(note) = note {
            self.viewer.message = note;
        }
        if let Some(number) = self.arguments.camera {
            if number >= self.viewer.cameras.len() {
                return Err(Error::argument(
                    "--camera",
                    format!("must be less than {}, the cameras found", self.viewer.cameras.len()),
                ));
            }
            self.viewer.jump(number);
        }
        if let Some(degrees) = self.arguments.orbit {
            self.viewer.viewpoint.orbit(degrees.to_radians(), 0.0, self.viewer.up);
        }
        Ok(())
    }

    fn size(&self) -> [u32; 2] {
        [self.config.width, self.config.height]
    }

    fn resize(&mut self, width: u32, height: u32) -> Result<()> {
        // Desktops of many screens have room for windows that no texture is as large as.
        let most = side_max(self.painter.gpu());
        let size = [width, height].map(|side| side.min(most));
        if size.contains(&0) || size == self.size() {
            return Ok(());
        }
        [self.config.width, self.config.height] = size;
        self.configure()
    }

    /// Makes the surface what `config` says; without one there is no window to go on with.
    fn configure(&self) -> Result<()> {
        let gpu = self.painter.gpu();
        self.surface.configure(gpu.device(), &self.config);
        gpu.check().map_err(|e| {
            Error::Device(format!("the window can be drawn in no longer ({e}); open it again"))
        })
    }

    /// Says in the panel what went wrong, and goes on; without a device nothing does.
    fn say(&mut self, result: Result<()>) -> Result<()> {
        match result {
            Err(error) if !self.painter.gpu().is_lost() => {
                let text = error.to_string();
                // What goes wrong in every frame is said once.
                if self.viewer.message != text {
                    self.viewer.message = text;
                    self.window.request_redraw();
                }
                Ok(())
            }
            result => result,
        }
    }

    /// Puts a model that was read on its side.
    fn show(&mut self, loaded: Loaded) {
        let Loaded { side, path, stamp, model } = loaded;
        let viewer = &mut self.viewer;
        let model = match model {
            Ok(model) => model,
            // A file that cannot be read leaves what was there.
            Err(error) => {
                viewer.message = error.to_string();
                return;
            }
        };
        let drawable = match self.painter.upload(&model.file) {
            Ok(drawable) => drawable,
            Err(error) => {
                viewer.message = error.to_string();
                return;
            }
        };
        viewer.message = model.notes.join(" ");
        if let Some((_, cameras)) = self.dropped.take_if(|(dropped, _)| *dropped == path) {
            // Another scene with its own cameras or none, unless it is to be compared.
            viewer.is_placed &= viewer.compares();
            if !viewer.compares() || !cameras.is_empty() {
                viewer.up = up(&self.arguments, &cameras);
                viewer.cameras = cameras;
                viewer.at_camera = None;
                self.photo = None;
            }
        }
        if !viewer.is_placed {
            viewer.viewpoint = first_view(&model, &viewer.cameras, viewer.up, viewer.settings.fov);
            viewer.is_placed = true;
            if self.arguments.near.is_none() {
                viewer.settings.near = near(&model);
            }
        }
        viewer.shown[side] = Some(Shown { path, stamp, model, drawable });
        self.window.request_redraw();
    }

    /// Takes what the loader has read.
    fn receive(&mut self) {
        while let Some(loaded) = self.loader.next() {
            self.show(loaded);
            // Also to say why one cannot be shown.
            self.window.request_redraw();
        }
    }

    fn load(&mut self, side: usize, path: &Path) {
        let proxy = self.proxy.clone();
        // The window may have been closed meanwhile.
        self.loader.load(side, path, move || {
            let _ = proxy.send_event(Wake);
        });
    }

    fn choose(&mut self, side: usize, path: Option<PathBuf>) {
        self.viewer.chosen[side].clone_from(&path);
        match path {
            Some(path) => self.load(side, &path),
            None => {
                // Nor what may be under way to it.
                self.loader.forget(side);
                self.viewer.shown[side] = None;
            }
        }
    }

    /// Looks for models that came or changed.
    fn look(&mut self) {
        if let Some(folder) = &self.viewer.folder {
            // While a folder is empty, what was found before stays.
            if let Ok(found) = find_sources(folder) {
                let other = |s: &Source| !s.path.starts_with(folder);
                let kept = self.viewer.sources.iter().filter(|s| other(s)).cloned();
                let sources: Vec<_> = found.into_iter().chain(kept).collect();
                if sources != self.viewer.sources {
                    self.viewer.sources = sources;
                    self.window.request_redraw();
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

    fn dropped(&mut self, path: &Path) {
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
            Err(error) => self.viewer.message = error.to_string(),
        }
        self.window.request_redraw();
    }

    /// Runs the panel and the gestures, does what they ask for, and draws.
    fn frame(&mut self) -> Result<()> {
        let started = Instant::now();
        let size = self.size();
        let times = self.painter.times.latest();
        let mut actions = Vec::new();
        let input = self.input.take_egui_input(&self.window);
        let (viewer, photo) = (&mut self.viewer, &self.photo);
        let mut output = self.egui.run_ui(input, |ui| {
            if viewer.shows_panel {
                Panel::right("panel").exact_size(PANEL_WIDTH).show(ui, |ui| {
                    panel::panel(viewer, ui, times, &mut actions);
                });
            }
            CentralPanel::no_frame().show(ui, |ui| {
                let response =
                    ui.interact(ui.max_rect(), egui::Id::unique("splats"), Sense::click_and_drag());
                if !overlay::hold_divider(viewer, ui) {
                    gestures::pointer(viewer, ui, &response, size, &mut actions);
                }
                gestures::keys(viewer, ui, size, &mut actions);
                let clicked = response.interact_pointer_pos().filter(|_| response.clicked());
                if let Some((_, texture)) = photo {
                    overlay::photo(viewer, ui, size, texture);
                }
                overlay::cameras(viewer, ui, size, clicked, &mut actions);
                overlay::divider(viewer, ui);
            });
        });
        for action in actions {
            let done = self.act(action);
            self.say(done)?;
        }
        self.load_photo();
        let platform = std::mem::take(&mut output.platform_output);
        self.input.handle_platform_output(&self.window, platform);
        let delay = output.viewport_output.get(&ViewportId::ROOT).map(|v| v.repaint_delay);
        self.due = delay.and_then(|delay| started.checked_add(delay));
        self.draw(output)?;
        if self.viewer.recording.is_some() {
            let done = self.record_picture();
            self.say(done)?;
            self.window.request_redraw();
        }
        // How a frame's times got on: they are read in the next one.
        if times.is_none() && self.painter.times.are_pending() {
            self.due = Some(self.due.map_or(started + LOOK, |due| due.min(started + LOOK)));
        }
        self.viewer.frame_ms = started.elapsed().as_secs_f32() * 1e3;
        Ok(())
    }

    fn draw(&mut self, mut output: FullOutput) -> Result<()> {
        use wgpu::CurrentSurfaceTexture as Current;
        let gpu = Arc::clone(self.painter.gpu());
        let (device, queue) = (gpu.device(), gpu.queue());
        for (id, deltas) in output.textures_delta.set.drain() {
            for delta in deltas {
                self.panels.update_texture(device, queue, id, &delta);
            }
        }
        let free: Vec<_> = output.textures_delta.free.drain().collect();
        let current = match self.window.inner_size() {
            // Minimised: nothing to draw on.
            size if size.width == 0 || size.height == 0 => Current::Occluded,
            _ => self.surface.get_current_texture(),
        };
        let (texture, is_stale) = match current {
            Current::Success(texture) => (Some(texture), false),
            Current::Suboptimal(texture) => (Some(texture), true),
            Current::Outdated | Current::Lost => (None, true),
            Current::Timeout => {
                self.window.request_redraw();
                (None, false)
            }
            Current::Occluded => (None, false),
            Current::Validation => {
                self.say(gpu.check())?;
                (None, true)
            }
        };
        if let Some(texture) = texture {
            let target = texture.texture.create_view(&Default::default());
            let size = [texture.texture.width(), texture.texture.height()];
            let shot = self.viewer.shot(size);
            let mut encoder = device.create_command_encoder(&Default::default());
            let recorded = match self.painter.record(&mut encoder, &shot, &target) {
                // What was asked for has no room here: what has is taken, and why is said.
                Err(error) if self.viewer.settings.drawing == Drawing::Rasterizer => {
                    self.viewer.message = error.to_string();
                    self.viewer.settings.drawing = Drawing::Auto;
                    self.window.request_redraw();
                    self.painter.record(&mut encoder, &self.viewer.shot(size), &target)
                }
                recorded => recorded,
            };
            let (mut written, load) = match recorded {
                Ok(written) => (written, wgpu::LoadOp::Load),
                // The panel alone, which says why.
                Err(error) => {
                    self.say(Err(error))?;
                    encoder = device.create_command_encoder(&Default::default());
                    // It may have failed before this, and times without a beginning are an error.
                    self.painter.times.begin(&gpu);
                    ([false; STAGES.len()], wgpu::LoadOp::Clear(wgpu::Color::BLACK))
                }
            };
            let scale = output.pixels_per_point;
            let jobs = self.egui.tessellate(output.shapes, scale);
            let screen =
                egui_wgpu::ScreenDescriptor { size_in_pixels: size, pixels_per_point: scale };
            let uploads = self.panels.update_buffers(device, queue, &mut encoder, &jobs, &screen);
            let timestamp_writes = self.painter.panel_stamps();
            written[PANEL] = timestamp_writes.is_some();
            let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("panel"),
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: &target,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
                })],
                timestamp_writes,
                ..Default::default()
            });
            self.panels.render(&mut pass.forget_lifetime(), &jobs, &screen);
            self.painter.times.resolve(&mut encoder, written);
            queue.submit(uploads.into_iter().chain([encoder.finish()]));
            self.window.pre_present_notify();
            queue.present(texture);
            self.painter.times.submitted();
        }
        for id in &free {
            self.panels.free_texture(id);
        }
        if is_stale {
            self.configure()?;
            self.window.request_redraw();
        }
        // Callbacks of finished work run here.
        let _ = device.poll(wgpu::PollType::Poll);
        self.say(gpu.check())
    }

    fn act(&mut self, action: Action) -> Result<()> {
        let size = self.size();
        match action {
            Action::Choose(side, number) => {
                let path = number.and_then(|i| self.viewer.sources.get(i)).map(|s| s.path.clone());
                self.choose(side, path);
            }
            Action::Frame => {
                self.viewer.leave_camera(size);
                self.viewer.frame();
            }
            Action::Jump(number) => self.viewer.jump(number),
            Action::Focus(pixel) => {
                if !self.viewer.focus(&mut self.painter, size, pixel)? {
                    self.viewer.message = "There is nothing to look at there.".to_owned();
                }
            }
            Action::Screenshot => self.screenshot()?,
            Action::SaveExr => self.save_exr(),
            Action::Record => self.start_recording(),
            Action::StopRecording => self.viewer.recording = None,
        }
        self.window.request_redraw();
        Ok(())
    }

    /// Saves what is seen, without panel and cameras.
    fn screenshot(&mut self) -> Result<()> {
        let size = self.size();
        let rgba = self.painter.picture(&self.viewer.shot(size))?;
        let path = free_name("splat-view", ".png");
        self.viewer.message = said(&path, write_png(&path, size, &without_alpha(&rgba)));
        Ok(())
    }

    /// Saves the left model as splat_render's rasterizer draws it, with alpha and depth.
    fn save_exr(&mut self) {
        let Some(shown) = &self.viewer.shown[0] else { return };
        let file = &shown.model.file;
        let settings = &self.viewer.settings;
        let options = ProjectOptions {
            near: settings.near,
            antialiased: file.antialiased,
            ..ProjectOptions::default()
        };
        let camera = relative_to(self.viewer.camera(self.size()), file.origin);
        let gpu = self.painter.gpu();
        let image = gpu
            .project(&file.splats.params(settings.sh_degree), &camera, &options)
            .and_then(|projected| gpu.rasterize(&projected, settings.background));
        let path = free_name("splat-view", ".exr");
        let written = image.and_then(|image| write_exr(&path, &image));
        self.viewer.message = said(&path, written);
    }

    fn start_recording(&mut self) {
        let viewer = &mut self.viewer;
        if viewer.path.keys.len() < 2 {
            viewer.message = "Mark two places or more with K, then record.".to_owned();
            return;
        }
        let folder = free_name("splat-view-path", "");
        match std::fs::create_dir(&folder) {
            Ok(()) => {
                let recording = Recording::new(&viewer.path, viewer.pictures_between, folder);
                viewer.recording = Some(recording);
            }
            Err(error) => {
                viewer.message = format!("{}: cannot be made ({error})", folder.display());
            }
        }
    }

    /// Draws and saves the recording's next picture; one that fails ends it.
    fn record_picture(&mut self) -> Result<()> {
        let size = self.size();
        let viewer = &mut self.viewer;
        let Some(mut recording) = viewer.recording.take() else { return Ok(()) };
        let Some(place) = recording.place() else { return Ok(()) };
        viewer.leave_camera(size);
        viewer.viewpoint = place;
        let path = recording.folder.join(format!("{:04}.png", recording.next));
        let rgba = self.painter.picture(&viewer.shot(size))?;
        write_png(&path, size, &without_alpha(&rgba))?;
        recording.next += 1;
        let total = recording.total();
        if recording.next < total {
            viewer.recording = Some(recording);
        } else {
            viewer.message = format!("{total} pictures in {}", recording.folder.display());
        }
        Ok(())
    }

    /// Reads the photo of the camera that is looked from, once it is to be seen.
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
                let photo = photo.within(side_max(self.painter.gpu()) as usize);
                let image = egui::ColorImage::from_rgba_unmultiplied(photo.size, &photo.rgba);
                let texture = self.egui.load_texture("photo", image, Default::default());
                self.photo = Some((number, texture));
                self.window.request_redraw();
            }
            Err(error) => {
                viewer.message = error.to_string();
                viewer.photo_strength = 0.0;
                self.window.request_redraw();
            }
        }
    }
}

/// The first name with a number that nothing has yet, in the folder the program was started in.
fn free_name(stem: &str, ending: &str) -> PathBuf {
    let name = |number: u32| PathBuf::from(format!("{stem}-{number:03}{ending}"));
    (1..).map(name).find(|path| !path.exists()).unwrap_or_else(|| name(0))
}

fn said(path: &Path, written: Result<()>) -> String {
    written.map_or_else(|error| error.to_string(), |()| format!("Saved {}", path.display()))
}
