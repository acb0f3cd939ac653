//! Draws a frame of one model or two, into a window or a picture.

use std::sync::Arc;

use half::f16;
use splat_render::gpu::Gpu;
use splat_render::io::SplatFile;
use splat_render::{Camera, Error, Result};

use crate::blending::{Blending, Drawable};
use crate::composing::{Canvases, Composing, Look};
use crate::display::{Display, Drawing, Settings};
use crate::drawing_choice::DrawingChoice;
use crate::rasterizing::{PictureBuffers, Rasterizing};
use crate::stage_times::{
    BIN, BLEND, CANVAS, COMPOSE, PANEL, PROJECT, RASTERIZE, SECOND, SORT, STAGES, StageTimes,
    Stamps, Written,
};

const PICTURE: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;
/// Alignment of the rows of a copied texture, bytes.
const ROW: u32 = wgpu::COPY_BYTES_PER_ROW_ALIGNMENT;

/// Longest side of a texture, and so of a frame.
pub fn side_max(gpu: &Gpu) -> u32 {
    gpu.device().limits().max_texture_dimension_2d
}

/// Refuses frames that are larger than the device's textures.
pub fn check_size(gpu: &Gpu, [width, height]: [u32; 2]) -> Result<()> {
    let most = side_max(gpu);
    if width.max(height) <= most {
        return Ok(());
    }
    Err(Error::argument(
        "--size",
        format!(
            "sides of frames are up to {most} on {}, not {width}x{height}; give smaller ones",
            gpu.name()
        ),
    ))
}

#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    /// The camera, with the size of the picture.
    pub camera: Camera,
    pub settings: &'a Settings,
    /// The model; the left one if there are two.
    pub left: Option<&'a Drawable>,
    pub right: Option<&'a Drawable>,
    /// Start of the right model, as a fraction of the width.
    pub divider: f32,
    /// Depths at the ends of the color map, world units.
    pub depths: [f32; 2],
}

#[derive(Debug)]
pub struct Painter {
    gpu: Arc<Gpu>,
    blending: Blending,
    rasterizing: Rasterizing,
    composing: Composing,
    to_picture: Composing,
    canvases: Option<Canvases>,
    /// The rasterizer's buffers for a canvas; both sides use them in turn.
    buffers: Option<PictureBuffers>,
    choice: DrawingChoice,
    /// Whether the rasterizer drew the last timed frame; None if the choice ignores the frame.
    timed: Option<bool>,
    pub times: StageTimes,
}

impl Painter {
    pub fn new(gpu: Arc<Gpu>, format: wgpu::TextureFormat) -> Result<Self> {
        let painter = Self {
            blending: Blending::new(&gpu),
            rasterizing: Rasterizing::new(&gpu),
            composing: Composing::new(&gpu, format),
            to_picture: Composing::new(&gpu, PICTURE),
            canvases: None,
            buffers: None,
            choice: DrawingChoice::new(),
            timed: None,
            times: StageTimes::new(&gpu),
            gpu,
        };
        painter.gpu.check()?;
        Ok(painter)
    }

    pub fn upload(&self, file: &SplatFile) -> Result<Drawable> {
        self.blending.upload(&self.gpu, file)
    }

    /// Draws a frame; returns which stages have timestamps. Its last pass, compose, is recorded only.
    pub fn record(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        shot: &Shot<'_>,
        target: &wgpu::TextureView,
    ) -> Result<Written> {
        if let (Some(times), Some(rasterized)) = (self.times.new_times(), self.timed) {
            self.choice.timed(rasterized, times.iter().sum::<f32>() - times[PANEL]);
        }
        let is_timed = !self.times.are_pending();
        if is_timed {
            self.timed = None;
        }
        let rasterizes = self.fit(shot)?;
        self.times.begin(&self.gpu);
        // Submitted at once: the device need not wait for the panel, and times do not contain that.
        let mut models = self.gpu.device().create_command_encoder(&Default::default());
        let mut written = self.draw(&mut models, shot, rasterizes, true)?;
        self.gpu.queue().submit([models.finish()]);
        if is_timed && shot.settings.display == Display::Splats {
            let drew = |stage: usize| written[stage] || written[SECOND + stage];
            self.timed = (drew(RASTERIZE) != drew(BLEND)).then_some(drew(RASTERIZE));
        }
        let Some(canvases) = &self.canvases else { return Ok(written) };
        let compose = self.times.stamps(COMPOSE).render(0);
        written[COMPOSE] = compose.is_some();
        self.composing.record(&self.gpu, encoder, canvases, &look(shot), target, compose);
        Ok(written)
    }

    pub fn panel_stamps(&self) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        self.times.stamps(PANEL).render(0)
    }

    /// Whether pairs of the last frames did not fit, for which the next frame makes room.
    pub fn is_short(&mut self) -> bool {
        let _ = self.gpu.device().poll(wgpu::PollType::Poll);
        self.buffers.as_mut().is_some_and(|buffers| Rasterizing::is_short(&self.gpu, buffers))
    }

    /// Draws a frame and returns its RGBA bytes.
    pub fn picture(&mut self, shot: &Shot<'_>) -> Result<Vec<u8>> {
        let picture = self.draw_picture(shot)?;
        if self.is_short() { self.draw_picture(shot) } else { Ok(picture) }
    }

    fn draw_picture(&mut self, shot: &Shot<'_>) -> Result<Vec<u8>> {
        let rasterizes = self.fit(shot)?;
        let [width, height] = [shot.camera.width, shot.camera.height];
        let texture = self.gpu.device().create_texture(&wgpu::TextureDescriptor {
            label: Some("picture"),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: PICTURE,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let mut encoder = self.gpu.device().create_command_encoder(&Default::default());
        self.draw(&mut encoder, shot, rasterizes, false)?;
        let Some(canvases) = &self.canvases else { return Ok(Vec::new()) };
        let target = texture.create_view(&Default::default());
        self.to_picture.record(&self.gpu, &mut encoder, canvases, &look(shot), &target, None);
        let row = (4 * width).next_multiple_of(ROW);
        let bytes = u64::from(row) * u64::from(height);
        let readable = self.gpu.readable(bytes);
        copy(&mut encoder, &texture, [0, 0], [width, height], &readable, row);
        self.gpu.queue().submit([encoder.finish()]);
        let data = self.gpu.read(&[(&readable, bytes)])?;
        let rows = data[0].chunks_exact(row as usize);
        Ok(rows.flat_map(|row| row[..4 * width as usize].iter().copied()).collect())
    }

    /// Expected depth at a pixel in world units; None for empty pixels.
    pub fn depth_at(&mut self, shot: &Shot<'_>, pixel: [u32; 2]) -> Result<Option<f64>> {
        let settings = Settings { display: Display::Depth, ..*shot.settings };
        let shot = Shot { settings: &settings, ..*shot };
        self.fit(&shot)?;
        let mut encoder = self.gpu.device().create_command_encoder(&Default::default());
        self.draw(&mut encoder, &shot, false, false)?;
        let Some(canvases) = &self.canvases else { return Ok(None) };
        let is_right = shot.right.is_some() && pixel[0] >= column(&shot);
        let readable = self.gpu.readable(8);
        let texture = &canvases.textures[usize::from(is_right)];
        copy(&mut encoder, texture, pixel, [1, 1], &readable, ROW);
        self.gpu.queue().submit([encoder.finish()]);
        let data = self.gpu.read(&[(&readable, 8)])?;
        let texel: [u16; 4] = bytemuck::pod_read_unaligned(&data[0]);
        let [depth, .., alpha] = texel.map(|bits| f16::from_bits(bits).to_f64());
        // Pixels that are less than half opaque count as empty.
        Ok((alpha > 0.5).then(|| depth / alpha * f64::from(unit(&shot))))
    }

    /// Allocates the canvases and rasterizer buffers that the frame needs; whether the rasterizer draws it.
    fn fit(&mut self, shot: &Shot<'_>) -> Result<bool> {
        let size = [shot.camera.width, shot.camera.height];
        let two = shot.right.is_some();
        let fits = self.canvases.as_ref().is_some_and(|canvases| {
            canvases.size == size && (!two || canvases.textures[0] != canvases.textures[1])
        });
        if !fits {
            // Free the old ones' memory first; canvases that could not be allocated are not kept.
            self.canvases = None;
            let canvases = self.composing.canvases(&self.gpu, size, two);
            self.gpu.check()?;
            self.canvases = Some(canvases);
        }
        let rasterizes = self.rasterizes(shot);
        if !rasterizes && shot.settings.display == Display::Splats {
            self.buffers = None;
        }
        if rasterizes && self.buffers.as_ref().is_none_or(|r| r.size != size) {
            // Free the old one's memory first.
            self.buffers = None;
            match self.rasterizing.buffers(&self.gpu, size) {
                Ok(buffers) => self.buffers = Some(buffers),
                Err(error) if shot.settings.drawing == Drawing::Rasterizer => return Err(error),
                // Then the blending unit draws, which needs no such buffers.
                Err(_) => self.choice.rule_out_rasterizer(),
            }
        }
        Ok(rasterizes && self.buffers.is_some())
    }

    fn rasterizes(&mut self, shot: &Shot<'_>) -> bool {
        let splats: u32 = [shot.left, shot.right].iter().flatten().map(|m| m.splats().len()).sum();
        let pixels = shot.camera.width * shot.camera.height;
        shot.settings.display == Display::Splats
            && match shot.settings.drawing {
                Drawing::Auto => self.gpu.is_software() || self.choice.rasterizes(splats, pixels),
                Drawing::Rasterizer => true,
                Drawing::Blending => false,
            }
    }

    /// Records the models' pictures onto their canvases; returns which stages have timestamps.
    fn draw(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        shot: &Shot<'_>,
        rasterizes: bool,
        is_timed: bool,
    ) -> Result<Written> {
        let mut written = [false; STAGES.len()];
        let Some(canvases) = &self.canvases else { return Ok(written) };
        let middle = if shot.right.is_some() { column(shot) } else { canvases.size[0] };
        let sides = [(shot.left, [0, middle]), (shot.right, [middle, canvases.size[0]])];
        for (side, (model, columns)) in sides.into_iter().enumerate() {
            let canvas = &canvases.views[side];
            let Some(model) = model.filter(|_| columns[0] < columns[1]) else {
                if side == 0 {
                    clear(encoder, canvas);
                }
                continue;
            };
            let first = side * SECOND;
            let stamps = if is_timed { self.times.stamps(first) } else { Stamps::none() };
            let mut stages = &[PROJECT, SORT, BIN, RASTERIZE, CANVAS][..];
            let rasterized = match self.buffers.as_mut().filter(|_| rasterizes) {
                None => false,
                Some(buffers) => {
                    let (camera, settings) = (&shot.camera, shot.settings);
                    let drawn = self.rasterizing.draw(
                        &self.gpu,
                        &self.blending,
                        model,
                        buffers,
                        camera,
                        settings,
                        canvas,
                        columns,
                        &stamps,
                    );
                    match drawn {
                        Err(error) if settings.drawing == Drawing::Rasterizer => return Err(error),
                        // No memory for the pairs: the blending unit draws them.
                        drawn => {
                            if drawn.is_err() {
                                self.choice.rule_out_rasterizer();
                            }
                            drawn.is_ok()
                        }
                    }
                }
            };
            if !rasterized {
                stages = &[PROJECT, SORT, BLEND];
                self.blending.record(
                    &self.gpu,
                    encoder,
                    model,
                    &shot.camera,
                    shot.settings,
                    unit(shot),
                    canvas,
                    columns,
                    &stamps,
                )?;
            }
            for stage in stages {
                written[first + stage] = stamps.are_written();
            }
        }
        Ok(written)
    }
}

/// First pixel column of the right model.
fn column(shot: &Shot<'_>) -> u32 {
    (shot.divider.clamp(0.0, 1.0) * shot.camera.width as f32).round() as u32
}

/// Depth in world units that a canvas stores as 1.
fn unit(shot: &Shot<'_>) -> f32 {
    shot.depths[1].max(f32::MIN_POSITIVE)
}

fn look(shot: &Shot<'_>) -> Look {
    let unit = unit(shot);
    Look {
        background: shot.settings.background,
        divider: if shot.right.is_some() { column(shot) as f32 } else { f32::MAX },
        is_depth: u32::from(shot.settings.is_depth()),
        depth_range: shot.depths.map(|depth| depth / unit),
        padding: 0.0,
    }
}

fn clear(encoder: &mut wgpu::CommandEncoder, view: &wgpu::TextureView) {
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("clear"),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations {
                load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT),
                store: wgpu::StoreOp::Store,
            },
        })],
        ..Default::default()
    });
}

fn copy(
    encoder: &mut wgpu::CommandEncoder,
    texture: &wgpu::Texture,
    [x, y]: [u32; 2],
    [width, height]: [u32; 2],
    buffer: &wgpu::Buffer,
    row: u32,
) {
    encoder.copy_texture_to_buffer(
        wgpu::TexelCopyTextureInfo {
            texture,
            mip_level: 0,
            origin: wgpu::Origin3d { x, y, z: 0 },
            aspect: wgpu::TextureAspect::All,
        },
        wgpu::TexelCopyBufferInfo {
            buffer,
            layout: wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row),
                rows_per_image: None,
            },
        },
        wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
    );
}
