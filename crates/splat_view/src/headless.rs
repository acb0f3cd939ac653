//! Pictures without a window, by the renderer's own rasterizer: the same as `igsr render` draws.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use splat_render::cpu::Cpu;
use splat_render::extent::near_plane;
use splat_render::gpu::Gpu;
use splat_render::gpu_check::open_tested;
use splat_render::io::SplatFile;
use splat_render::{Camera, Error, Image, ProjectOptions, Projected, Result, Stages};

use crate::arguments::{Arguments, Backend};
use crate::detail::view;
use crate::display::{Drawing, Settings};
use crate::drawing_choice::TIMED;
use crate::model::Model;
use crate::painter::{Painter, Shot, check_size};
use crate::picture_files::{to_bytes, write_exr, write_png};
use crate::print_line;
use crate::scene_view::{background, cameras_of, first_camera, first_view, up};
use crate::sources::find_sources;
use crate::stage_times::STAGES;
use crate::start::no_levels;
use crate::viewpoint::{Viewpoint, fitted, relative_to};

const SIZE: [u32; 2] = [1280, 720];

struct Scene {
    /// If in levels of detail, holds the splats for the last picture's camera.
    model: Model,
    camera: Camera,
    viewpoint: Viewpoint,
    settings: Settings,
    up: glam::DVec3,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let mut scene = Scene::new(arguments)?;
    if let Some(frames) = arguments.time {
        scene.look(&scene.camera.clone())?;
        return time(&scene, frames);
    }
    let stages = stages(arguments.backend)?;
    if let Some(path) = &arguments.screenshot {
        let mut camera = scene.camera;
        if let Some(degrees) = arguments.orbit {
            camera = scene.turned(degrees);
        }
        scene.look(&camera)?;
        let image = scene.draw(&*stages, &camera)?;
        return write(path, &image);
    }
    if let Some(folder) = &arguments.frames {
        make_empty(folder)?;
        let count = arguments.orbit.unwrap_or(1.0) as u32;
        for i in 0..count {
            let camera = scene.turned(360.0 * f64::from(i) / f64::from(count));
            scene.look(&camera)?;
            let image = scene.draw(&*stages, &camera)?;
            write(&folder.join(format!("{i:04}.png")), &image)?;
        }
    }
    Ok(())
}

/// Makes a folder for pictures. A folder with files is refused, so that two turntables do not mix.
fn make_empty(folder: &Path) -> Result<()> {
    let unwritable = |e| Error::file(folder, format!("cannot be created ({e}); name another"));
    std::fs::create_dir_all(folder).map_err(unwritable)?;
    if std::fs::read_dir(folder).map_err(unwritable)?.next().is_some() {
        return Err(Error::file(folder, "is not empty; name a new folder for --frames"));
    }
    Ok(())
}

/// The backend that draws; prints a message if `auto` finds no GPU.
fn stages(backend: Backend) -> Result<Arc<dyn Stages<f32>>> {
    match backend {
        Backend::Cpu => Ok(Arc::new(Cpu)),
        Backend::Gpu => Ok(open_tested(true)?),
        Backend::Auto => match open_tested(false) {
            Ok(gpu) => Ok(gpu),
            Err(error) => {
                match error {
                    Error::NoAdapter(_) => eprintln!("No GPU was found; the CPU draws."),
                    error => eprintln!("{error}. The CPU draws."),
                }
                Ok(Arc::new(Cpu))
            }
        },
    }
}

impl Scene {
    fn new(arguments: &Arguments) -> Result<Self> {
        let path = &arguments.scenes[0];
        let source = find_sources(path)?.remove(0);
        let model = Model::read(&source.path, arguments.budget)?;
        if arguments.budget.is_some() && model.detail.is_none() {
            return Err(no_levels());
        }
        let (cameras, note) = cameras_of(arguments.cameras.as_deref(), Some(path))?;
        for note in model.notes.iter().chain(&note) {
            print_line(note);
        }
        let up = up(arguments, &cameras, &model);
        let fov = arguments.fov.map(f64::to_radians);
        let background = background(arguments, Some(path));
        let mut settings = Settings { background, ..Settings::default() };
        settings.near = arguments.near.unwrap_or_else(|| near_plane(model.radius));
        settings.drawing = arguments.drawing;
        settings.fov = fov.unwrap_or(settings.fov);
        let mut viewpoint = first_view(&model, &cameras, up, settings.fov);
        let mut camera = viewpoint.camera(arguments.size.unwrap_or(SIZE), settings.fov);
        if let Some(number) = first_camera(arguments, &cameras)? {
            let found = &cameras[number];
            let own = match arguments.camera {
                Some(_) => [found.camera.width, found.camera.height],
                None => SIZE,
            };
            camera = fitted(&found.camera, arguments.size.unwrap_or(own));
            viewpoint = Viewpoint::of_camera(&found.camera, model.center, model.radius);
        }
        Ok(Self { model, camera, viewpoint, settings, up })
    }

    /// Reads a camera's splats of a scene in levels of detail, and reports their number.
    fn look(&mut self, camera: &Camera) -> Result<()> {
        let Some(detail) = &mut self.model.detail else { return Ok(()) };
        let choice = detail.choose(&view(camera, self.settings.near));
        // Free the last picture's copy before reading.
        self.model.file = SplatFile::default();
        while let Some(loaded) = detail.load_next(&choice) {
            loaded?;
        }
        let drawn = detail.drawn(&choice);
        let (splats, cells) = detail.total();
        eprintln!(
            "{} of {splats} splats, in {} of {cells} cells; {} are in memory.",
            drawn.file.splats.len(),
            drawn.cells,
            detail.most()
        );
        self.model.file = drawn.file;
        Ok(())
    }

    /// The camera, turned by degrees about the scene's center.
    fn turned(&self, degrees: f64) -> Camera {
        let mut viewpoint = self.viewpoint;
        viewpoint.orbit(degrees.to_radians(), 0.0, self.up);
        Camera { viewmat: viewpoint.viewmat(), ..self.camera }
    }

    fn project(&self, stages: &dyn Stages<f32>, camera: &Camera) -> Result<Projected<f32>> {
        let file = &self.model.file;
        let options = ProjectOptions {
            near: self.settings.near,
            antialiased: file.antialiased,
            ..ProjectOptions::default()
        };
        let camera = relative_to(*camera, file.origin);
        let params = file.splats.params(self.settings.sh_degree);
        stages.project(&params, &camera, &options)
    }

    fn draw(&self, stages: &dyn Stages<f32>, camera: &Camera) -> Result<Image<f32>> {
        stages.rasterize(&self.project(stages, camera)?, self.settings.background)
    }
}

fn write(path: &Path, image: &Image<f32>) -> Result<()> {
    if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("exr")) {
        return write_exr(path, image);
    }
    write_png(path, [image.width, image.height], &to_bytes(image))
}

/// Times frames as the window draws them, and compares the picture with the rasterizer's.
fn time(scene: &Scene, frames: u32) -> Result<()> {
    let gpu = Arc::new(Gpu::new(true)?);
    check_size(&gpu, [scene.camera.width, scene.camera.height])?;
    println!("{} splats on {}", scene.model.file.splats.len(), gpu.name());
    let format = wgpu::TextureFormat::Rgba8Unorm;
    let mut painter = Painter::new(Arc::clone(&gpu), format)?;
    let model = painter.upload(&scene.model.file)?;
    let [width, height] = [scene.camera.width, scene.camera.height];
    let target = gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: Some("frame"),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    });
    let target = target.create_view(&Default::default());
    let mut stages: Vec<[f32; STAGES.len()]> = Vec::new();
    let mut whole = Vec::new();
    // The first frames compile, and choose the renderer.
    let chooses = scene.settings.drawing == Drawing::Auto && !gpu.is_software();
    let first = if chooses { 1 + 2 * TIMED as u32 } else { 1 };
    for i in 0..first + frames {
        let started = Instant::now();
        let camera = scene.turned(f64::from(i));
        let shot = scene.shot(camera, &model);
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        let written = painter.record(&mut encoder, &shot, &target)?;
        painter.times.resolve(&mut encoder, written);
        gpu.queue().submit([encoder.finish()]);
        painter.times.submitted();
        gpu.device()
            .poll(wgpu::PollType::wait_indefinitely())
            .map_err(|e| Error::Device(format!("{} did not finish ({e})", gpu.name())))?;
        gpu.check()?;
        if i >= first {
            whole.push(started.elapsed().as_secs_f32() * 1e3);
            stages.extend(painter.times.latest());
        } else {
            painter.times.latest();
        }
    }
    println!("median milliseconds of {frames} frames at {width}x{height}");
    for (stage, name) in STAGES.iter().enumerate() {
        let took: Vec<f32> = stages.iter().map(|times| times[stage]).collect();
        if took.iter().any(|&ms| ms > 0.0) {
            println!("{name:>12} {:9.2}", median(took));
        }
    }
    // Submission and other time outside the timestamps.
    let rest = whole.iter().zip(&stages).map(|(whole, times)| whole - times.iter().sum::<f32>());
    println!("{:>12} {:9.2}", "rest", median(rest.collect()));
    let least = whole.iter().copied().fold(f32::INFINITY, f32::min);
    println!("{:>12} {:9.2}", "whole", median(whole));
    println!("{:>12} {least:9.2}", "least");
    let shot = scene.shot(scene.camera, &model);
    let seen = painter.picture(&shot)?;
    let exact = scene.draw(&*gpu, &scene.camera)?;
    let bytes = to_bytes(&exact);
    let seen = seen.chunks_exact(4).flat_map(|p| &p[..3]);
    let apart: Vec<u32> = seen.zip(&bytes).map(|(&a, &b)| u32::from(a.abs_diff(b))).collect();
    println!(
        "off the rasterizer's picture by {} of 255 at most, {:.4} on average",
        apart.iter().max().unwrap_or(&0),
        f64::from(apart.iter().sum::<u32>()) / apart.len().max(1) as f64
    );
    Ok(())
}

impl Scene {
    fn shot<'a>(&'a self, camera: Camera, model: &'a crate::blending::Drawable) -> Shot<'a> {
        Shot {
            camera,
            settings: &self.settings,
            left: Some(model),
            right: None,
            divider: 1.0,
            depths: [0.0, 1.0],
        }
    }
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
}
