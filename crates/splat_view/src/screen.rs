//! The window's surface, and egui on it: frames are composed here and shown.

use std::sync::Arc;
use std::time::Duration;

use egui::epaint::ClippedShape;
use egui::{TextureId, Ui, ViewportId};
use splat_render::gpu::Gpu;
use splat_render::{Error, Result};
use wgpu::CurrentSurfaceTexture as Current;
use winit::dpi::{LogicalSize, PhysicalSize, Size};
use winit::event::WindowEvent;
use winit::event_loop::ActiveEventLoop;
use winit::window::Window;

use crate::painter::{check_size, side_max};

/// Default window size, in logical pixels.
const SIZE: LogicalSize<f64> = LogicalSize::new(1280.0, 720.0);

/// winit's error message, without the file and line at its start.
pub fn reason(error: &impl std::fmt::Display) -> String {
    let text = error.to_string();
    let rest = text.strip_prefix("os error at ").and_then(|text| text.split_once(": "));
    rest.map_or(text.as_str(), |(_, reason)| reason).to_owned()
}

pub struct Screen {
    pub window: Arc<Window>,
    /// The device that the surface belongs to.
    pub gpu: Arc<Gpu>,
    pub egui: egui::Context,
    surface: wgpu::Surface<'static>,
    config: wgpu::SurfaceConfiguration,
    input: egui_winit::State,
    renderer: egui_wgpu::Renderer,
}

/// egui's output for one frame; its textures are on the device already.
pub struct Interface {
    shapes: Vec<ClippedShape>,
    scale: f32,
    /// Textures that no later frame uses.
    unused: Vec<TextureId>,
    /// How long egui can wait for the next frame.
    pub repaint_delay: Option<Duration>,
}

impl Screen {
    /// Opens a window that is not visible yet, `size` pixels large if given.
    pub fn open(event_loop: &ActiveEventLoop, size: Option<[u32; 2]>) -> Result<Self> {
        let inner = size
            .map_or(Size::from(SIZE), |[width, height]| PhysicalSize::new(width, height).into());
        let attributes = Window::default_attributes().with_title("splat-view");
        let attributes = attributes.with_inner_size(inner).with_visible(false);
        let failed = |what: String| Error::Device(format!("no window can be opened ({what})"));
        let window = event_loop.create_window(attributes).map_err(|e| failed(reason(&e)))?;
        let window = Arc::new(window);
        let (gpu, adapter, surface) = Gpu::for_window(Arc::clone(&window))?;
        if let Some(size) = size {
            check_size(&gpu, size)?;
        }
        let most = side_max(&gpu);
        let size = window.inner_size();
        let mut config = surface
            .get_default_config(&adapter, size.width.clamp(1, most), size.height.clamp(1, most))
            .ok_or_else(|| failed(format!("{} cannot draw in it", gpu.name())))?;
        // Colors are encoded as they are shown, and egui blends them so.
        let formats = surface.get_capabilities(&adapter).formats;
        config.format = formats.iter().copied().find(|f| !f.is_srgb()).unwrap_or(config.format);
        config.present_mode = wgpu::PresentMode::AutoVsync;
        surface.configure(gpu.device(), &config);
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
        let renderer = egui_wgpu::Renderer::new(gpu.device(), config.format, Default::default());
        Ok(Self { window, gpu: Arc::new(gpu), egui, surface, config, input, renderer })
    }

    pub fn format(&self) -> wgpu::TextureFormat {
        self.config.format
    }

    pub fn size(&self) -> [u32; 2] {
        [self.config.width, self.config.height]
    }

    /// Adapts the surface to a new size of the window.
    pub fn resize(&mut self, width: u32, height: u32) -> Result<()> {
        // Desktops of several screens allow windows larger than any texture.
        let most = side_max(&self.gpu);
        let size = [width, height].map(|side| side.min(most));
        if size.contains(&0) || size == self.size() {
            return Ok(());
        }
        [self.config.width, self.config.height] = size;
        self.configure()
    }

    /// Configures the surface again. An error means that the window cannot go on.
    pub fn configure(&self) -> Result<()> {
        self.surface.configure(self.gpu.device(), &self.config);
        self.gpu.check().map_err(|e| {
            Error::Device(format!("the window can no longer be drawn ({e}); open it again"))
        })
    }

    /// Passes an event to egui, and requests a frame if egui wants one.
    pub fn pass_to_egui(&mut self, event: &WindowEvent) {
        let response = self.input.on_window_event(&self.window, event);
        // A frame that asked for the next one would redraw a window without end in which nothing moves.
        if response.repaint && *event != WindowEvent::RedrawRequested {
            self.window.request_redraw();
        }
    }

    pub fn run_ui(&mut self, ui: impl FnMut(&mut Ui)) -> Interface {
        let input = self.input.take_egui_input(&self.window);
        let mut output = self.egui.run_ui(input, ui);
        // At once: whatever fails until the frame is shown, egui counts on its textures.
        for (id, deltas) in output.textures_delta.set.drain() {
            for delta in deltas {
                self.renderer.update_texture(self.gpu.device(), self.gpu.queue(), id, &delta);
            }
        }
        let unused = output.textures_delta.free.drain().collect();
        self.input.handle_platform_output(&self.window, output.platform_output);
        Interface {
            shapes: output.shapes,
            scale: output.pixels_per_point,
            unused,
            repaint_delay: output.viewport_output.get(&ViewportId::ROOT).map(|v| v.repaint_delay),
        }
    }

    /// The texture to draw in, if any, and whether the surface must be configured again.
    pub fn acquire(&self) -> Result<(Option<wgpu::SurfaceTexture>, bool)> {
        let current = match self.window.inner_size() {
            // Minimized: there is nothing to draw on.
            size if size.width == 0 || size.height == 0 => Current::Occluded,
            _ => self.surface.get_current_texture(),
        };
        Ok(match current {
            Current::Success(texture) => (Some(texture), false),
            Current::Suboptimal(texture) => (Some(texture), true),
            Current::Outdated | Current::Lost => (None, true),
            Current::Timeout => {
                self.window.request_redraw();
                (None, false)
            }
            Current::Occluded => (None, false),
            Current::Validation => {
                self.gpu.check()?;
                (None, true)
            }
        })
    }

    /// Records the interface onto a target. Submit the returned buffers before the encoder's.
    pub fn record(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        interface: &mut Interface,
        target: &wgpu::TextureView,
        load: wgpu::LoadOp<wgpu::Color>,
        timestamp_writes: Option<wgpu::RenderPassTimestampWrites<'_>>,
    ) -> Vec<wgpu::CommandBuffer> {
        let (device, queue) = (self.gpu.device(), self.gpu.queue());
        let shapes = std::mem::take(&mut interface.shapes);
        let jobs = self.egui.tessellate(shapes, interface.scale);
        let size_in_pixels = [target.texture().width(), target.texture().height()];
        let screen =
            egui_wgpu::ScreenDescriptor { size_in_pixels, pixels_per_point: interface.scale };
        let uploads = self.renderer.update_buffers(device, queue, encoder, &jobs, &screen);
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("panel"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
            })],
            timestamp_writes,
            ..Default::default()
        });
        self.renderer.render(&mut pass.forget_lifetime(), &jobs, &screen);
        uploads
    }

    pub fn show(
        &self,
        texture: wgpu::SurfaceTexture,
        commands: impl IntoIterator<Item = wgpu::CommandBuffer>,
    ) {
        self.gpu.queue().submit(commands);
        self.window.pre_present_notify();
        self.gpu.queue().present(texture);
    }

    /// Frees this frame's textures.
    pub fn finish(&mut self, interface: &Interface) {
        for id in &interface.unused {
            self.renderer.free_texture(id);
        }
    }
}
