//! The window driven for real: Xvfb is the display, xdotool the hand, a software adapter may draw.

#![cfg(target_os = "linux")]

mod common;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::dragging::drop_file;
use common::{
    Folder, Picture, ball, command, draw, program, read_png, refused, write, write_cameras,
    write_in_levels,
};
use glam::{DMat4, DVec3};
use splat_render::Camera;

/// Longest that anything may take on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);
/// Hint if a tool or a library is missing.
const INSTALL: &str = "run `make display`, or install xvfb, xdotool, libxcursor1, libxi6, libxrandr2, \
                       libx11-xcb1 and libxkbcommon-x11-0";
/// The window's first size; small, since a software adapter draws.
const SIZE: [usize; 2] = [320, 240];
/// Bounds on a window's difference from the rasterizer, in 255ths (docs/guides/viewing.md).
const MOST: u8 = 3;
const MEAN: f64 = 0.5;
/// The bound if the rasterizer draws in the window.
const RASTERIZED_MOST: u8 = 1;

/// A virtual display.
struct Xvfb {
    server: Child,
    name: String,
    folder: Folder,
}

impl Xvfb {
    fn start() -> Self {
        let folder = Folder::new();
        let mut server = Command::new("Xvfb")
            .args("-displayfd 1 -screen 0 640x480x24 -noreset -nolisten tcp -fbdir".split(' '))
            .arg(&folder.0)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|e| panic!("these tests need Xvfb ({e}): {INSTALL}"));
        let mut name = String::new();
        let mut out = BufReader::new(server.stdout.take().expect("its output"));
        out.read_line(&mut name).expect("Xvfb says which display it is");
        assert!(!name.is_empty(), "Xvfb ends at once: {INSTALL}");
        Self { server, name: format!(":{}", name.trim()), folder }
    }

    fn xdotool(&self, arguments: &[&str]) -> String {
        self.answer(arguments).unwrap_or_else(|text| panic!("xdotool {arguments:?}: {text}"))
    }

    /// xdotool's output, an error if it fails.
    fn answer(&self, arguments: &[&str]) -> Result<String, String> {
        let output = Command::new("xdotool")
            .env("DISPLAY", &self.name)
            .args(arguments)
            .output()
            .unwrap_or_else(|e| panic!("these tests need xdotool ({e}): {INSTALL}"));
        let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        if output.status.success() { Ok(text) } else { Err(text) }
    }

    /// The viewer's window once it is there; the test fails if the viewer ends before.
    fn window_of(&self, program: &mut Child) -> String {
        let started = Instant::now();
        loop {
            let found = self.answer(&["search", "--onlyvisible", "--name", "splat-view"]);
            if let Ok(window) = found {
                return window;
            }
            if let Ok(Some(status)) = program.try_wait() {
                panic!("splat-view ended ({status}) before its window opened: {INSTALL}");
            }
            assert!(started.elapsed() < PATIENCE, "splat-view opens no window");
            std::thread::sleep(Duration::from_millis(30));
        }
    }

    /// The upper left corner of the display, from Xvfb's file.
    fn seen(&self, [width, height]: [usize; 2]) -> Picture {
        let bytes = std::fs::read(self.folder.join("Xvfb_screen0")).expect("the screen");
        let word = |i: usize| {
            let word: [u8; 4] = bytes[4 * i..4 * i + 4].try_into().expect("a word");
            u32::from_be_bytes(word) as usize
        };
        // XWD: size of the header, ..., bytes of a line (13th), ..., number of colors (20th).
        let (start, line) = (word(0) + 12 * word(19), word(12));
        let pixel = |x: usize, y: usize| {
            let at = start + y * line + 4 * x;
            [bytes[at + 2], bytes[at + 1], bytes[at]]
        };
        let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect();
        Picture { size: [width, height], rgb }
    }
}

impl Drop for Xvfb {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// The viewer on that display.
struct Viewer<'a> {
    xvfb: &'a Xvfb,
    program: Child,
    window: String,
    folder: &'a Path,
    shots: u32,
}

impl<'a> Viewer<'a> {
    fn start(xvfb: &'a Xvfb, folder: &'a Path, options: &str) -> Self {
        let mut program = program()
            .env("DISPLAY", &xvfb.name)
            .current_dir(folder)
            .args(options.split(' '))
            .args(["--size", &format!("{}x{}", SIZE[0], SIZE[1])])
            .stdout(Stdio::null())
            .spawn()
            .expect("splat-view starts");
        let window = xvfb.window_of(&mut program);
        let mut viewer = Self { xvfb, program, window, folder, shots: 0 };
        // No window manager gives it the keyboard.
        viewer.xvfb.xdotool(&["windowfocus", "--sync", &viewer.window]);
        viewer.xvfb.xdotool(&["mousemove", "100", "120"]);
        // The panel away, so that all of the window is picture.
        viewer.key("h");
        viewer
    }

    fn key(&mut self, key: &str) {
        self.xvfb.xdotool(&["key", key]);
    }

    /// Drags with a button in steps, as a hand does.
    fn drag(&mut self, button: &str, [from, to]: [[i32; 2]; 2]) {
        let x = self.xvfb;
        let at = |part: i32| [0, 1].map(|i| (from[i] + (to[i] - from[i]) * part / 8).to_string());
        let moved = |part: i32| {
            let [a, b] = at(part);
            x.xdotool(&["mousemove", &a, &b]);
            std::thread::sleep(Duration::from_millis(40));
        };
        moved(0);
        x.xdotool(&["mousedown", button]);
        (1..=8).for_each(moved);
        x.xdotool(&["mouseup", button]);
    }

    /// A screenshot by key.
    fn shot(&mut self) -> Picture {
        // Keys are handled in order, so earlier ones are in the picture.
        self.key("p");
        self.shots += 1;
        let path = self.folder.join(format!("splat-view-{:03}.png", self.shots));
        self.wait_for(&format!("{}", path.display()), |_| path.exists());
        read_png(&path)
    }

    /// Waits until the display shows a picture.
    fn shows(&mut self, picture: &Picture) {
        // The display's file has the pointer in it.
        self.xvfb.xdotool(&["mousemove", "620", "460"]);
        let xvfb = self.xvfb;
        self.wait_for("the picture on the display", |_| {
            xvfb.seen(picture.size).apart(picture).0 <= 1
        });
        self.xvfb.xdotool(&["mousemove", "100", "120"]);
    }

    fn wait_for(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> bool) {
        let started = Instant::now();
        while !done(self) {
            if let Ok(Some(status)) = self.program.try_wait() {
                panic!("splat-view ended ({status}) before {what}");
            }
            assert!(started.elapsed() < PATIENCE, "{what} did not come");
            std::thread::sleep(Duration::from_millis(30));
        }
    }

    /// Shots until one is as wanted.
    fn shot_when(&mut self, what: &str, mut wanted: impl FnMut(&Picture) -> bool) -> Picture {
        let mut last = None;
        self.wait_for(what, |viewer| {
            let picture = viewer.shot();
            let done = wanted(&picture);
            last = Some(picture);
            done
        });
        last.expect("a shot")
    }
}

impl Drop for Viewer<'_> {
    fn drop(&mut self) {
        let _ = self.program.kill();
        let _ = self.program.wait();
    }
}

/// The rasterizer's picture of a scene in its first view, with further options.
fn rasterized(scene: &Path, [width, height]: [usize; 2], options: &str) -> Picture {
    draw(scene, &format!("--size {width}x{height} {options}")).0
}

fn agree(name: &str, one: &Picture, other: &Picture) {
    let (most, mean) = one.apart(other);
    println!("{name}: {most} at most, {mean:.4} on average");
    assert!(most <= MOST && mean <= MEAN, "{name}: off by {most}, on average {mean}");
}

fn differ(name: &str, one: &Picture, other: &Picture) {
    let (_, mean) = one.apart(other);
    assert!(mean > 1.0, "{name}: the pictures are alike ({mean})");
}

fn scenes(folder: &Folder) -> [PathBuf; 2] {
    let tints = [[0.8, 0.3, 0.2], [0.2, 0.4, 0.8]];
    [0, 1].map(|i| {
        let path = folder.join(&format!("scene{i}.ply"));
        write(&path, &ball(600, 20, tints[i]));
        path
    })
}

#[test]
fn a_window_draws_orbits_zooms_resizes_and_shows_what_it_saves() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let [scene, _] = scenes(&folder);
    let mut viewer = Viewer::start(&xvfb, &folder.0, "scene0.ply --draw rasterize");
    let first = viewer.shot();
    assert_eq!(first.size, SIZE);
    agree("first view", &first, &rasterized(&scene, SIZE, ""));
    let (most, _) = first.apart(&rasterized(&scene, SIZE, ""));
    assert!(most <= RASTERIZED_MOST, "the rasterizer's picture is off by {most}");
    // The window shows the same, pixel by pixel.
    viewer.shows(&first);

    viewer.drag("1", [[100, 120], [180, 130]]);
    let turned = viewer.shot();
    differ("an orbit", &first, &turned);
    viewer.shows(&turned);
    viewer.drag("3", [[100, 120], [160, 150]]);
    let panned = viewer.shot();
    differ("a pan", &turned, &panned);
    // The pan has moved the picture with the pointer: to the right and down.
    let middle = |p: &Picture| {
        let light = |i: usize| f64::from(p.rgb[3 * i]) + f64::from(p.rgb[3 * i + 2]);
        let pixels = p.size[0] * p.size[1];
        let total: f64 = (0..pixels).map(light).sum();
        let sum = |at: &dyn Fn(usize) -> usize| {
            (0..pixels).map(|i| light(i) * at(i) as f64).sum::<f64>() / total
        };
        [sum(&|i| i % p.size[0]), sum(&|i| i / p.size[0])]
    };
    let (before, after) = (middle(&turned), middle(&panned));
    assert!(after[0] > before[0] + 15.0 && after[1] > before[1] + 5.0, "{before:?} {after:?}");
    xvfb.xdotool(&["mousemove", "100", "120", "click", "--repeat", "5", "4"]);
    let mut last = panned;
    // The wheel is smoothed over some frames.
    let zoomed = viewer.shot_when("the end of the zoom", |shot| {
        let rests = shot.apart(&last).1 == 0.0;
        last = shot.clone();
        rests
    });
    let lit = |p: &Picture| p.rgb.chunks_exact(3).filter(|p| p.iter().any(|&v| v > 20)).count();
    assert!(lit(&zoomed) > lit(&turned), "zooming in shows no more: {}", lit(&zoomed));

    viewer.key("f");
    agree("all of the scene again", &viewer.shot(), &rasterized(&scene, SIZE, ""));
    let size = [400, 200];
    xvfb.xdotool(&["windowsize", "--sync", &viewer.window, "400", "200"]);
    let resized = viewer.shot_when("the new size", |shot| shot.size == size);
    agree("after the resize", &resized, &rasterized(&scene, size, ""));
    viewer.shows(&resized);
    // A double click centers a splat.
    xvfb.xdotool(&["mousemove", "230", "110", "click", "--repeat", "2", "--delay", "20", "1"]);
    let focused = viewer.shot_when("the focus", |shot| shot.apart(&resized).1 > 1.0);
    assert!(middle(&focused)[0] < middle(&resized)[0] - 5.0, "the scene did not move to the left");
}

#[test]
fn all_displays_differ_and_keys_move_the_camera() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let [scene, _] = scenes(&folder);
    let background = "--background 0.2,0.4,0.6";
    let options = format!("scene0.ply {background} --draw blend");
    let mut viewer = Viewer::start(&xvfb, &folder.0, &options);
    agree("blended", &viewer.shot(), &rasterized(&scene, SIZE, background));
    let mut seen: Vec<Picture> = Vec::new();
    for key in ["1", "2", "3", "4", "5"] {
        viewer.key(key);
        let picture = viewer.shot();
        for other in &seen {
            differ(&format!("display {key}"), other, &picture);
        }
        assert_eq!(picture.rgb[..3], [51, 102, 153], "display {key} covers the background");
        seen.push(picture);
    }
    viewer.key("1");
    let before = viewer.shot();
    assert!(before == seen[0], "back to splats is not the same picture");
    xvfb.xdotool(&["keydown", "d"]);
    std::thread::sleep(Duration::from_millis(300));
    xvfb.xdotool(&["keyup", "d"]);
    differ("D moves", &before, &viewer.shot());
    // Two places marked, and the path between them recorded.
    viewer.key("k");
    viewer.drag("1", [[100, 120], [150, 120]]);
    viewer.key("k");
    viewer.key("r");
    let last = folder.join("splat-view-path-001/0030.png");
    viewer.wait_for("the path's last picture", |_| last.exists());
    let path =
        |number: u32| read_png(&folder.join(&format!("splat-view-path-001/{number:04}.png")));
    differ("the path's ends", &path(0), &path(30));
    viewer.xvfb.xdotool(&["key", "shift+p"]);
    let exr = folder.join("splat-view-001.exr");
    viewer.wait_for("the EXR", |_| exr.exists());
    let image = exr::prelude::read_first_flat_layer_from_file(&exr).expect("an EXR");
    assert_eq!(image.layer_data.channel_data.list.len(), 5);
}

#[test]
fn two_models_are_compared_at_a_divider_and_changed_files_appear() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let [left, right] = scenes(&folder);
    let expected = [&left, &right].map(|scene| rasterized(scene, SIZE, ""));
    differ("the two models", &expected[0], &expected[1]);
    let mut viewer = Viewer::start(&xvfb, &folder.0, "scene0.ply scene1.ply");
    let halves = |picture: &Picture, at: usize| {
        agree("left", &picture.columns(0, at), &expected[0].columns(0, at));
        agree("right", &picture.columns(at, SIZE[0]), &expected[1].columns(at, SIZE[0]));
    };
    halves(&viewer.shot(), 160);
    viewer.drag("1", [[160, 50], [80, 50]]);
    halves(&viewer.shot(), 80);
    // The left file is written again: it is read again, and the camera stays.
    write(&left, &ball(600, 20, [0.2, 0.4, 0.8]));
    let again = rasterized(&right, SIZE, "");
    let changed = viewer.shot_when("the changed file", |shot| {
        shot.columns(0, 80).apart(&again.columns(0, 80)).1 < MEAN
    });
    agree("changed", &changed, &again);
    // A broken file changes nothing.
    std::fs::write(&left, "ply\nthis is none").expect("write");
    std::thread::sleep(Duration::from_secs(1));
    agree("broken", &viewer.shot(), &again);
}

#[test]
fn a_refinement_s_folder_opens_and_a_new_scene_in_it_appears() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let [red, blue] = scenes(&folder);
    let (red, blue) = (rasterized(&red, SIZE, ""), rasterized(&blue, SIZE, ""));
    write(&folder.join("out/rounds/0/scene.ply"), &ball(600, 20, [0.8, 0.3, 0.2]));
    write(&folder.join("out/scene.ply"), &ball(600, 20, [0.8, 0.3, 0.2]));
    let mut viewer = Viewer::start(&xvfb, &folder.0, "out");
    agree("round 0", &viewer.shot(), &red);
    write(&folder.join("out/rounds/1/scene.ply"), &ball(600, 20, [0.2, 0.4, 0.8]));
    write(&folder.join("out/scene.ply"), &ball(600, 20, [0.2, 0.4, 0.8]));
    let changed = viewer.shot_when("round 1", |shot| shot.apart(&blue).1 < MEAN);
    agree("round 1", &changed, &blue);
}

#[test]
fn a_scene_in_levels_refines_within_its_budget_and_follows_the_camera() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let levels = write_in_levels(&folder, &ball(3000, 20, [0.8, 0.3, 0.2]));
    let path = folder.join("cameras.json");
    write_cameras(&path, &cameras());
    let options = format!("--cameras {} --budget 1500", path.display());
    let [near, far] = [0, 1].map(|n| rasterized(&levels, SIZE, &format!("{options} --camera {n}")));
    differ("the cameras", &near, &far);
    let mut viewer = Viewer::start(&xvfb, &folder.0, &format!("levels {options}"));
    // Coarser levels are near enough in the mean, and drawn until these are read.
    let as_fine = |shot: &Picture, expected: &Picture| {
        let (most, mean) = shot.apart(expected);
        most <= MOST && mean <= MEAN
    };
    viewer.shot_when("levels", |shot| as_fine(shot, &near));
    viewer.key("bracketright");
    viewer.shot_when("other levels", |shot| as_fine(shot, &far));
}

/// Three cameras of the window's size: two near, and one behind that sees them.
fn cameras() -> [Camera; 3] {
    let [width, height] = SIZE.map(|side| side as u32);
    [(0.35, 4.0), (-0.6, 5.0), (0.0, 9.0)].map(|(angle, distance)| Camera {
        viewmat: DMat4::from_translation(DVec3::new(0.0, 0.0, distance))
            * DMat4::from_rotation_y(angle),
        fx: 260.0,
        fy: 260.0,
        cx: 0.5 * f64::from(width),
        cy: 0.5 * f64::from(height),
        width,
        height,
    })
}

#[test]
fn cameras_are_jumped_to_scenes_dropped_and_recordings_stopped() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let [scene, _] = scenes(&folder);
    write_cameras(&folder.join("cameras.json"), &cameras());
    let expected = [0, 1, 2].map(|n| rasterized(&scene, SIZE, &format!("--camera {n}")));
    let mut viewer = Viewer::start(&xvfb, &folder.0, "scene0.ply");
    agree("the first picture is the first camera's", &viewer.shot(), &expected[0]);
    for (key, camera) in
        [("bracketright", 1), ("bracketright", 2), ("bracketleft", 1), ("bracketleft", 0)]
    {
        viewer.key(key);
        agree(&format!("{key} to camera {camera}"), &viewer.shot(), &expected[camera]);
    }
    viewer.key("bracketleft");
    agree("around to the last camera", &viewer.shot(), &expected[2]);
    // A click at the first camera's frustum in the last camera's picture.
    viewer.key("c");
    let [first, _, last] = cameras();
    let at = last.viewmat.transform_point3(first.center());
    let place = [last.fx * at.x / at.z + last.cx, last.fy * at.y / at.z + last.cy];
    let [x, y] = place.map(|v| (v.round() as i32).to_string());
    xvfb.xdotool(&["mousemove", &x, &y, "click", "1"]);
    let jumped = viewer.shot_when("the first camera's view", |shot| {
        shot.apart(&expected[0]).1 < MEAN && shot.apart(&expected[2]).1 > MEAN
    });
    agree("after the click", &jumped, &expected[0]);

    // Another scene, which has no cameras.
    let other = folder.join("other place/scene.ply");
    write(&other, &ball(500, 21, [0.3, 0.7, 0.4]));
    let alone = rasterized(&other, SIZE, "");
    differ("the dropped scene", &alone, &expected[0]);
    drop_file(&xvfb.name, viewer.window.parse().expect("a number"), &other);
    let dropped = viewer.shot_when("the dropped scene", |shot| shot.apart(&alone).1 < MEAN);
    agree("dropped", &dropped, &alone);
    // The first drag goes on from there.
    viewer.drag("3", [[100, 120], [101, 120]]);
    assert!(viewer.shot().apart(&alone).1 < 3.0, "the camera jumps at the first drag");

    // A path of 91 pictures, stopped early.
    viewer.key("k");
    for to in [150, 60, 120] {
        viewer.drag("1", [[100, 120], [to, 120]]);
        viewer.key("k");
    }
    viewer.key("r");
    let path = folder.join("splat-view-path-001");
    viewer.wait_for("the first picture", |_| path.join("0000.png").exists());
    viewer.key("Escape");
    viewer.shot();
    let count = || std::fs::read_dir(&path).expect("pictures").count();
    let stopped = count();
    assert!((1..91).contains(&stopped), "{stopped} pictures");
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(count(), stopped, "the recording goes on");
}

#[test]
fn windows_without_an_adapter_or_larger_than_any_texture_are_refused() {
    let (xvfb, folder) = (Xvfb::start(), Folder::new());
    let [scene, _] = scenes(&folder);
    let mut large = command(&scene, "--size 9000x40");
    refused(large.env("DISPLAY", &xvfb.name), &["--size", "up to 8192", "9000x40"]);
    let mut hidden = command(&scene, "");
    hidden.env("VK_DRIVER_FILES", "/nothing").env("VK_ICD_FILENAMES", "/nothing");
    let words = ["no Vulkan, Metal or DX12 adapter", "mesa-vulkan-drivers"];
    refused(hidden.env("DISPLAY", &xvfb.name), &words);
    let mut viewer = Viewer::start(&xvfb, &folder.0, "scene0.ply");
    xvfb.xdotool(&["windowsize", "--sync", &viewer.window, "9000", "40"]);
    viewer.shot_when("the largest size", |shot| shot.size == [8192, 40]);
    let size = [200, 100];
    xvfb.xdotool(&["windowsize", "--sync", &viewer.window, "200", "100"]);
    let again = viewer.shot_when("a usual size", |shot| shot.size == size);
    agree("after the largest size", &again, &rasterized(&scene, size, ""));
}
