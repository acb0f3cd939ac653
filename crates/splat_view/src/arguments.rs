//! The command line.

use std::ffi::OsString;
use std::path::PathBuf;

use lexopt::prelude::*;
use splat_render::{Error, Result};

use crate::display::Drawing;

pub const HELP: &str = "\
Show Gaussian splats in a window, or draw pictures of them.

splat-view [OPTIONS] SCENE [SCENE...]

SCENE is a splat file (.ply, .compressed.ply, .splat, .ksplat, .spz, .sog, .glb, .gltf) or the folder
of an igsr fit or igsr refine. A folder is watched: new and changed models appear. Two scenes are
compared side by side. A folder with a lod-meta.json, by igsr convert --lod or of other programs, is a
scene in levels of detail: what the camera is near is drawn fine, the rest coarse.

Pictures without a window:
  --screenshot FILE    draw one picture: .png, or .exr with alpha and depth
  --frames DIR         draw --orbit N pictures of a full turn: DIR/0000.png, ...; DIR is new or empty
  --time N             draw N frames as the window does, and print the time of each stage
  --size WxH           size of the pictures or the window; default 1280x720, or the camera's size
  --backend NAME       auto: a real GPU if there is one, else cpu; gpu: also a software GPU; cpu

In the window and for --time:
  --draw NAME          rasterize: as --screenshot does; blend: by the GPU's blending unit;
                       auto (default): rasterize on software GPUs, else blend

Levels of detail:
  --budget N           most splats of a scene that are in memory and drawn; default 1000000

View:
  --cameras PATH       cameras.json of igsr, or a folder with one; default: that of the fit which
                       SCENE is of. For COLMAP and transforms.json use: igsr view SCENE --cameras PATH
  --camera N           start at camera N of the capture, from 0; default: 0, where there are cameras
  --orbit DEG          turn about the scene's center; with --frames: the number of pictures
  --up AXIS            up axis: x, y, z, -x, -y or -z; default: from the cameras, else estimated
  --fov DEG            vertical field of view, 5 to 150; default 50
  --near DISTANCE      near plane; default a ten-thousandth of the scene's radius
  --background COLOR   white, black, gray or R,G,B in 0..1; default: the fit's, else black

  --help, --version";

/// Backend that renders without a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Backend {
    /// A real GPU if one answers, else the CPU.
    #[default]
    Auto,
    /// Any adapter, software ones too.
    Gpu,
    Cpu,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct Arguments {
    pub scenes: Vec<PathBuf>,
    pub screenshot: Option<PathBuf>,
    /// Folder for pictures of a full turn.
    pub frames: Option<PathBuf>,
    pub time: Option<u32>,
    pub size: Option<[u32; 2]>,
    pub backend: Backend,
    pub drawing: Drawing,
    pub cameras: Option<PathBuf>,
    /// Maximum number of splats of a scene in levels of detail.
    pub budget: Option<usize>,
    /// Number of the camera to start at.
    pub camera: Option<usize>,
    /// Degrees about the scene's center, or a number of pictures.
    pub orbit: Option<f64>,
    /// The up axis, a unit vector.
    pub up: Option<[f64; 3]>,
    /// Vertical field of view in degrees.
    pub fov: Option<f64>,
    /// Near plane in world units.
    pub near: Option<f32>,
    /// Behind the splats, RGB in 0..1.
    pub background: Option<[f32; 3]>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Asked {
    Help,
    Version,
    Run(Box<Arguments>),
}

const FRAMES_MAX: f64 = 100_000.0;

impl Arguments {
    /// Reads the command line, the program's name left out.
    pub fn parse(words: impl IntoIterator<Item = OsString>) -> Result<Asked> {
        let mut out = Self::default();
        let mut parser = lexopt::Parser::from_args(words);
        let wrong = |error: lexopt::Error| {
            Error::argument("splat-view", format!("{error}; see splat-view --help"))
        };
        while let Some(word) = parser.next().map_err(wrong)? {
            let name = match word {
                Long(name) => name.to_owned(),
                Short('h') => "help".to_owned(),
                Value(path) => {
                    out.scenes.push(path.into());
                    continue;
                }
                word @ Short(_) => return Err(wrong(word.unexpected())),
            };
            let mut value = || parser.value().map_err(wrong);
            match name.as_str() {
                "help" => return Ok(Asked::Help),
                "version" => return Ok(Asked::Version),
                "screenshot" => out.screenshot = Some(value()?.into()),
                "frames" => out.frames = Some(value()?.into()),
                "cameras" => out.cameras = Some(value()?.into()),
                "time" => {
                    out.time = Some(number("--time", &value()?, 1.0, 10_000.0, true)? as u32);
                }
                "size" => out.size = Some(size(&value()?)?),
                "backend" => out.backend = backend(&value()?)?,
                "draw" => out.drawing = drawing(&value()?)?,
                "budget" => {
                    out.budget = Some(number("--budget", &value()?, 1.0, 1e9, true)? as usize);
                }
                "camera" => {
                    out.camera = Some(number("--camera", &value()?, 0.0, 1e9, true)? as usize);
                }
                "orbit" => {
                    out.orbit = Some(number("--orbit", &value()?, -1e6, 1e6, false)?);
                }
                "up" => out.up = Some(axis(&value()?)?),
                "fov" => out.fov = Some(number("--fov", &value()?, 5.0, 150.0, false)?),
                "near" => {
                    out.near = Some(number("--near", &value()?, 1e-6, 1e9, false)? as f32);
                }
                "background" => out.background = Some(color(&value()?)?),
                _ => return Err(wrong(Long(&name).unexpected())),
            }
        }
        out.check()?;
        Ok(Asked::Run(Box::new(out)))
    }

    pub fn is_headless(&self) -> bool {
        self.screenshot.is_some() || self.frames.is_some() || self.time.is_some()
    }

    fn check(&self) -> Result<()> {
        let kinds = [self.screenshot.is_some(), self.frames.is_some(), self.time.is_some()];
        if kinds.iter().filter(|&&given| given).count() > 1 {
            return Err(Error::argument(
                "--screenshot, --frames, --time",
                "cannot be combined; give one of them",
            ));
        }
        if self.is_headless() && self.scenes.is_empty() {
            return Err(Error::argument("SCENE", "is missing; give a splat file or a folder"));
        }
        if self.is_headless() && self.scenes.len() > 1 {
            return Err(Error::argument(
                "SCENE",
                format!(
                    "must be a single scene without a window, not {}; leave {} out",
                    self.scenes.len(),
                    self.scenes[1].display()
                ),
            ));
        }
        if self.drawing != Drawing::Auto && self.is_headless() && self.time.is_none() {
            return Err(Error::argument(
                "--draw",
                "applies to the window and to --time; pictures without a window are always \
                 rasterized",
            ));
        }
        let ending = |path: &PathBuf| path.extension().map(|e| e.to_ascii_lowercase());
        if let Some(path) = &self.screenshot
            && !ending(path).is_some_and(|ending| ending == "png" || ending == "exr")
        {
            return Err(Error::argument(
                "--screenshot",
                format!("must end in .png or .exr, not {}", path.display()),
            ));
        }
        if self.frames.is_some() {
            let count = self.orbit.unwrap_or(0.0);
            if count.fract() != 0.0 || !(1.0..=FRAMES_MAX).contains(&count) {
                return Err(Error::argument(
                    "--orbit",
                    "must be the number of pictures with --frames, such as 60",
                ));
            }
        }
        Ok(())
    }
}

fn text(name: &str, value: &OsString) -> Result<String> {
    let bad = || Error::argument(name, format!("{value:?} is not text"));
    value.to_str().map(str::to_owned).ok_or_else(bad)
}

fn number(name: &str, value: &OsString, least: f64, most: f64, whole: bool) -> Result<f64> {
    let kind = if whole { "a whole number" } else { "a number" };
    let text = text(name, value)?;
    match text.trim().parse::<f64>() {
        Ok(number) if (least..=most).contains(&number) && (!whole || number.fract() == 0.0) => {
            Ok(number)
        }
        _ => Err(Error::argument(
            name,
            format!("must be {kind} from {least} to {most}, not {text:?}"),
        )),
    }
}

fn size(value: &OsString) -> Result<[u32; 2]> {
    let most = splat_render::constants::SIDE_MAX;
    let text = text("--size", value)?;
    let side = |side: &str| side.parse().ok().filter(|s| (1..=most).contains(s));
    text.split_once('x').and_then(|(w, h)| Some([side(w)?, side(h)?])).ok_or_else(|| {
        Error::argument(
            "--size",
            format!("must be two sides from 1 to {most} such as 800x600, not {text:?}"),
        )
    })
}

fn backend(value: &OsString) -> Result<Backend> {
    match value.to_str() {
        Some("auto") => Ok(Backend::Auto),
        Some("gpu") => Ok(Backend::Gpu),
        Some("cpu") => Ok(Backend::Cpu),
        _ => Err(Error::argument("--backend", format!("must be auto, gpu or cpu, not {value:?}"))),
    }
}

fn drawing(value: &OsString) -> Result<Drawing> {
    let found = Drawing::ALL.iter().find(|(_, name)| value.to_str() == Some(name));
    found.map(|(drawing, _)| *drawing).ok_or_else(|| {
        Error::argument("--draw", format!("must be auto, rasterize or blend, not {value:?}"))
    })
}

fn axis(value: &OsString) -> Result<[f64; 3]> {
    let text = text("--up", value)?;
    let (sign, name) = text.strip_prefix('-').map_or((1.0, text.as_str()), |rest| (-1.0, rest));
    let axis = ["x", "y", "z"].iter().position(|&axis| axis == name).ok_or_else(|| {
        Error::argument("--up", format!("must be x, y, z, -x, -y or -z, not {text:?}"))
    })?;
    let mut up = [0.0; 3];
    up[axis] = sign;
    Ok(up)
}

fn color(value: &OsString) -> Result<[f32; 3]> {
    let text = text("--background", value)?;
    let named = [("black", 0.0), ("white", 1.0), ("gray", 0.5)];
    if let Some((_, gray)) = named.iter().find(|(name, _)| *name == text) {
        return Ok([*gray; 3]);
    }
    let parts: Vec<f32> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    match parts[..] {
        [r, g, b] if parts.iter().all(|c| (0.0..=1.0).contains(c)) => Ok([r, g, b]),
        _ => Err(Error::argument(
            "--background",
            format!(
                "must be white, black, gray or three numbers in 0..1 such as 0.2,0.2,0.2, not \
                 {text:?}"
            ),
        )),
    }
}
