//! Shared by the tests: random scenes, temporary folders, and the program.

#![allow(dead_code, reason = "each test file uses its own part")]

#[cfg(target_os = "linux")]
pub mod dragging;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicU32, Ordering};

use glam::{DMat4, DVec3};
use splat_render::Camera;
use splat_render::fit::SplatArrays;
use splat_render::io::{SplatFile, write_splats};
use splat_render::levels::write_levels;

/// A new folder, deleted on drop.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("splat-view-test-{}-{number}", std::process::id());
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).expect("a folder for the test");
        Self(path)
    }

    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Pseudorandom numbers in 0..1.
pub struct Numbers(u64);

impl Numbers {
    pub fn next(&mut self) -> f32 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }

    fn about(&mut self, middle: f32, spread: f32) -> f32 {
        middle + spread * (2.0 * self.next() - 1.0)
    }
}

/// Splats of SH degree 1 in a ball about the origin, of colors about `tint`.
pub fn ball(count: usize, seed: u64, tint: [f32; 3]) -> SplatFile {
    let mut n = Numbers(seed);
    let mut splats = SplatArrays { sh_degree: 1, ..SplatArrays::default() };
    while splats.len() < count {
        let at = [n.about(0.0, 1.0), n.about(0.0, 1.0), n.about(0.0, 1.0)];
        if at.iter().map(|v| v * v).sum::<f32>() > 1.0 {
            continue;
        }
        splats.means.push(at);
        let quat = std::array::from_fn(|_| n.about(0.0, 1.0));
        splats.quats.push(quat);
        splats.scales.push(std::array::from_fn(|_| n.about(-2.6, 0.8)));
        splats.opacities.push(n.about(0.5, 2.5));
        splats.sh.push(tint.map(|v| n.about((v - 0.5) / 0.282, 0.5)));
        for _ in 0..3 {
            splats.sh.push(std::array::from_fn(|_| n.about(0.0, 0.3)));
        }
    }
    SplatFile { splats, origin: [0.0; 3], antialiased: false }
}

/// Writes splats in the format of the ending.
pub fn write(path: &Path, file: &SplatFile) {
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("folder");
    write_splats(path, file).expect("a splat file");
}

/// A ply in a new folder.
pub fn saved(file: &SplatFile) -> (Folder, PathBuf) {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, file);
    (folder, scene)
}

/// Writes a scene to the folder, and its levels of detail to the folder's `levels`.
pub fn write_in_levels(folder: &Folder, file: &SplatFile) -> PathBuf {
    let (scene, levels) = (folder.join("scene.ply"), folder.join("levels"));
    write(&scene, file);
    std::fs::create_dir(&levels).expect("a folder");
    write_levels(&scene, &levels, 3, 200, &mut || true).expect("levels");
    levels
}

/// A checkpoint as numpy's savez writes it.
pub fn write_checkpoint(path: &Path, file: &SplatFile, (at, unit): ([f64; 3], f64)) {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).expect("file"));
    let stored =
        zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut member = |name: &str, kind: &str, shape: &str, data: Vec<u8>| {
        let mut header =
            format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}");
        while !(header.len() + 11).is_multiple_of(64) {
            header.push(' ');
        }
        header.push('\n');
        zip.start_file(format!("{name}.npy"), stored).expect("member");
        zip.write_all(b"\x93NUMPY\x01\x00").expect("write");
        zip.write_all(&(header.len() as u16).to_le_bytes()).expect("write");
        zip.write_all(header.as_bytes()).expect("write");
        zip.write_all(&data).expect("write");
    };
    let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let (s, n) = (&file.splats, file.splats.len());
    let means: Vec<f32> = s.means.as_flattened().iter().map(|v| v / unit as f32).collect();
    let scales: Vec<f32> = s.scales.as_flattened().iter().map(|v| v - unit.ln() as f32).collect();
    member("means", "<f4", &format!("{n}, 3"), floats(&means));
    member("quats", "<f4", &format!("{n}, 4"), floats(s.quats.as_flattened()));
    member("scales", "<f4", &format!("{n}, 3"), floats(&scales));
    member("opacities", "<f4", &format!("{n},"), floats(&s.opacities));
    member("sh", "<f4", &format!("{n}, {}, 3", s.stride()), floats(s.sh.as_flattened()));
    let doubles = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
    let origin: [f64; 3] = std::array::from_fn(|k| (file.origin[k] - at[k]) / unit);
    member("origin", "<f8", "3,", doubles(&origin));
    member("frame", "<f8", "4,", doubles(&[at[0], at[1], at[2], unit]));
    zip.finish().expect("zip");
}

/// A camera 4 units off, with its middle elsewhere than the picture's.
pub fn camera() -> Camera {
    Camera {
        viewmat: DMat4::from_translation(DVec3::new(0.1, -0.2, 4.0))
            * DMat4::from_rotation_y(0.6)
            * DMat4::from_rotation_x(0.3),
        fx: 110.0,
        fy: 100.0,
        cx: 60.0,
        cy: 35.0,
        width: 120,
        height: 80,
    }
}

/// A file of cameras in igsr's format, with missing photos.
pub fn cameras_json(cameras: &[Camera]) -> String {
    let frame = |(i, camera): (usize, &Camera)| {
        let to_world = camera.viewmat.inverse() * DMat4::from_scale(DVec3::new(1.0, -1.0, -1.0));
        let rows: Vec<[f64; 4]> = (0..4).map(|i| to_world.row(i).to_array()).collect();
        format!(
            "{{\"file_path\": \"{i}.png\", \"w\": {}, \"h\": {}, \"fl_x\": {}, \"fl_y\": {}, \
             \"cx\": {}, \"cy\": {}, \"transform_matrix\": {rows:?}}}",
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        )
    };
    let frames: Vec<String> = cameras.iter().enumerate().map(frame).collect();
    format!("{{\"camera_model\": \"PINHOLE\", \"frames\": [{}]}}", frames.join(", "))
}

/// Writes [`cameras_json`].
pub fn write_cameras(path: &Path, cameras: &[Camera]) {
    std::fs::write(path, cameras_json(cameras)).expect("cameras");
}

/// The program, without any display.
pub fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-view"));
    let desktop = ["DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR", "NODEVICE_SELECT"];
    for name in desktop {
        command.env_remove(name);
    }
    command
}

/// The program with a scene and options, which are separated by spaces.
pub fn command(scene: &Path, options: &str) -> Command {
    let mut command = program();
    command.arg(scene).args(options.split_whitespace());
    command
}

/// Runs a command, and asserts that it succeeds.
pub fn run(command: &mut Command) -> Output {
    let output = command.output().expect("splat-view starts");
    assert!(output.status.success(), "{command:?}: {}", said(&output));
    output
}

/// Draws a scene on the CPU; returns the picture, and the program's messages.
pub fn draw(scene: &Path, options: &str) -> (Picture, String) {
    let out = scene.with_extension("drawn.png");
    let mut command = command(scene, options);
    let output = run(command.args(["--backend", "cpu", "--screenshot"]).arg(&out));
    (read_png(&out), said(&output))
}

/// The program's messages.
pub fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).trim_end().to_owned()
}

/// Asserts that a command ends with one error message that contains the words.
pub fn refused(command: &mut Command, words: &[&str]) {
    refused_with(&command.output().expect("splat-view starts"), words);
}

/// [`refused`] of a command that has ended.
pub fn refused_with(output: &Output, words: &[&str]) {
    let text = said(output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert_eq!(text.lines().count(), 1, "not one message: {text}");
    assert!(text.ends_with('.') && !text.contains("panicked"), "{text}");
    assert!(!text.contains(char::is_control), "{text:?}");
    for word in words {
        assert!(text.contains(word), "{word} is not in: {text}");
    }
}

/// An 8-bit RGB picture.
#[derive(Clone, PartialEq)]
pub struct Picture {
    pub size: [usize; 2],
    pub rgb: Vec<u8>,
}

/// Reads a PNG that the program wrote.
pub fn read_png(path: &Path) -> Picture {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().expect("a PNG");
    let mut rgb = vec![0; reader.output_buffer_size().expect("a size")];
    let info = reader.next_frame(&mut rgb).expect("pixels");
    assert_eq!(info.color_type, png::ColorType::Rgb);
    Picture { size: [info.width as usize, info.height as usize], rgb }
}

impl Picture {
    /// Columns `begin..end`.
    pub fn columns(&self, begin: usize, end: usize) -> Self {
        let row = |row: &[u8]| row[3 * begin..3 * end].to_vec();
        let rgb = self.rgb.chunks_exact(3 * self.size[0]).flat_map(row).collect();
        Self { size: [end - begin, self.size[1]], rgb }
    }

    /// Largest and mean difference of a byte.
    pub fn apart(&self, other: &Self) -> (u8, f64) {
        assert_eq!(self.size, other.size);
        let each = self.rgb.iter().zip(&other.rgb).map(|(a, b)| a.abs_diff(*b));
        let sum: u64 = each.clone().map(u64::from).sum();
        (each.max().unwrap_or(0), sum as f64 / self.rgb.len() as f64)
    }
}
