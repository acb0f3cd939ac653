//! Pictures without a window.

mod common;

use std::path::Path;

use common::{
    Folder, Picture, ball, camera, command, draw, read_png, run, said, saved, write, write_cameras,
    write_checkpoint, write_in_levels,
};
use glam::{DMat4, DVec3};
use splat_render::cpu::Cpu;
use splat_render::io::SplatFile;
use splat_render::{Camera, Image, ProjectOptions, Stages};

fn drawn(file: &SplatFile, camera: &Camera, background: [f32; 3]) -> Image<f32> {
    let params = file.splats.params(4);
    let projected = Cpu.project(&params, camera, &ProjectOptions::default()).expect("project");
    Cpu.rasterize(&projected, background).expect("rasterize")
}

fn picture(image: &Image<f32>) -> Picture {
    let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let size = [image.width as usize, image.height as usize];
    Picture { size, rgb: image.color.iter().flatten().map(byte).collect() }
}

fn assert_lit(picture: &Picture) {
    assert!(picture.rgb.iter().any(|&v| v > 60), "the scene is dark");
}

#[test]
fn pictures_are_the_rasterizer_s_on_cpu_and_gpu() {
    let file = ball(300, 1, [0.6, 0.4, 0.3]);
    let (folder, scene) = saved(&file);
    let out = folder.join("out.png");
    write_cameras(&folder.join("cameras.json"), &[camera()]);
    let expected = picture(&drawn(&file, &camera(), [0.0; 3]));
    for backend in ["cpu", "gpu"] {
        let mut command = command(&scene, &format!("--camera 0 --backend {backend}"));
        let output = run(command.arg("--screenshot").arg(&out));
        // Mesa's error message on machines without a desktop.
        assert!(!said(&output).contains("XDG_RUNTIME_DIR"), "{}", said(&output));
        let off = read_png(&out).apart(&expected).0;
        assert!(off <= 1, "{backend} is off by {off}");
    }
    assert_lit(&expected);
}

#[test]
fn exr_holds_color_alpha_and_expected_depth() {
    let file = ball(200, 2, [0.5; 3]);
    let (folder, scene) = saved(&file);
    let out = folder.join("out.exr");
    write_cameras(&folder.join("cameras.json"), &[camera()]);
    run(command(&scene, "--camera 0 --backend cpu --screenshot").arg(&out));
    let image = exr::prelude::read_first_flat_layer_from_file(&out).expect("an EXR");
    let names: Vec<String> =
        image.layer_data.channel_data.list.iter().map(|c| c.name.to_string()).collect();
    assert_eq!(names, ["A", "B", "G", "R", "Z"]);
    let channel = |i: usize| -> Vec<f32> {
        image.layer_data.channel_data.list[i].sample_data.values_as_f32().collect()
    };
    let expected = drawn(&file, &camera(), [0.0; 3]);
    let depth: Vec<f32> = expected
        .depth
        .iter()
        .zip(&expected.alpha)
        .map(|(d, a)| if *a > 0.0 { d / a } else { 0.0 })
        .collect();
    assert_eq!(channel(0), expected.alpha);
    assert_eq!(channel(3), expected.color.iter().map(|c| c[0]).collect::<Vec<_>>());
    assert_eq!(channel(4), depth);
    assert!(depth.iter().any(|d| (2.5..5.5).contains(d)));
}

#[test]
fn size_orbit_up_and_background_change_the_picture() {
    let folder = Folder::new();
    let scene = folder.join("scene.splat");
    write(&scene, &ball(300, 3, [0.3, 0.5, 0.7]));
    let draw = |options: &str| draw(&scene, &format!("--size 90x60 {options}")).0;
    let first = draw("");
    assert_eq!(first.size, [90, 60]);
    assert!(draw("--orbit 40").apart(&first).1 > 2.0, "an orbit changes nothing");
    assert!(draw("--orbit 360").apart(&first).0 <= 1, "a full turn does not return");
    assert!(draw("--up z").apart(&first).1 > 2.0, "up changes nothing");
    assert_eq!(draw("--background 0.2,0.4,1").rgb[..3], [51, 102, 255]);
    // The whole scene is in the picture, and larger than a dot.
    let lit = first.rgb.chunks_exact(3).filter(|p| p.iter().any(|&v| v > 20)).count();
    assert!((90 * 60 / 10..90 * 60).contains(&lit), "{lit} pixels are lit");
}

#[test]
fn frames_of_a_full_turn_are_all_different() {
    let (folder, scene) = saved(&ball(200, 4, [0.5, 0.3, 0.6]));
    let frames = folder.join("frames");
    run(command(&scene, "--orbit 4 --size 60x40 --backend cpu --frames").arg(&frames));
    let mut names: Vec<String> = std::fs::read_dir(&frames)
        .expect("frames")
        .map(|e| e.expect("entry").file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    assert_eq!(names, ["0000.png", "0001.png", "0002.png", "0003.png"]);
    let pictures: Vec<_> = names.iter().map(|name| read_png(&frames.join(name))).collect();
    for (i, one) in pictures.iter().enumerate() {
        for other in &pictures[..i] {
            assert!(one.apart(other).1 > 1.0, "two frames are alike");
        }
    }
}

#[test]
fn splats_that_are_not_finite_are_left_out_and_counted() {
    let folder = Folder::new();
    let (clean, dirty) = (folder.join("clean.ply"), folder.join("dirty.ply"));
    let file = ball(100, 5, [0.4; 3]);
    write(&clean, &file);
    let mut with = file.clone();
    let mut broken = ball(3, 6, [1.0; 3]);
    broken.splats.means[0][1] = f32::NAN;
    broken.splats.scales[1][0] = f32::INFINITY;
    broken.splats.sh[2 * 4] = [f32::NAN; 3];
    with.splats.append(&broken.splats);
    write(&dirty, &with);
    write_cameras(&folder.join("cameras.json"), &[camera()]);
    let (dirty_picture, notes) = draw(&dirty, "--camera 0");
    assert!(draw(&clean, "--camera 0").0 == dirty_picture, "broken splats change the picture");
    assert!(notes.contains("3 of 103 splats"), "{notes}");
}

#[test]
fn a_checkpoint_gives_the_picture_of_its_scene() {
    let folder = Folder::new();
    let mut file = ball(150, 10, [0.4, 0.6, 0.3]);
    // Means are relative to an origin that f32 could not hold them at.
    file.origin = [1e7, -2e7, 5.0];
    write(&folder.join("a/scene.ply"), &file);
    for name in ["b", "c"] {
        std::fs::create_dir_all(folder.join(name)).expect("folder");
    }
    write_checkpoint(&folder.join("b/checkpoint.npz"), &file, ([0.0; 3], 1.0));
    // A fit's frame has its own origin and unit; the logarithm of the unit is rounded.
    write_checkpoint(&folder.join("c/checkpoint.npz"), &file, ([1.0, -2.0, 0.5], 4.0));
    let draw = |name: &str| draw(&folder.join(name), "--size 80x60").0;
    let scene = draw("a");
    assert!(scene == draw("b"));
    let apart = scene.apart(&draw("c"));
    assert!(apart.0 <= 1, "off by {apart:?}");
    assert_lit(&scene);
}

#[test]
fn a_scaled_scene_gives_the_same_picture() {
    let file = ball(300, 16, [0.6, 0.4, 0.3]);
    let (folder, scene) = saved(&file);
    let other = folder.join("other.ply");
    let draw = |scene: &Path, options: &str| draw(scene, &format!("--size 90x60 {options}")).0;
    let drawn = draw(&scene, "");
    for (factor, origin) in [(1e-4, 0.0), (1e-2, 0.0), (100.0, 0.0), (1e4, 0.0), (1.0, 5e5)] {
        let mut file = file.clone();
        file.splats.means.as_flattened_mut().iter_mut().for_each(|v| *v *= factor);
        file.splats.scales.as_flattened_mut().iter_mut().for_each(|v| *v += factor.ln());
        file.origin = [origin; 3];
        write(&other, &file);
        let apart = drawn.apart(&draw(&other, ""));
        assert!(apart.0 <= 2 && apart.1 < 0.1, "{factor} {origin}: off by {apart:?}");
    }
    // An explicit near plane stays.
    assert!(draw(&other, "--near 1000").rgb.iter().all(|&v| v == 0), "near is nothing");
}

#[test]
fn the_file_that_igsr_writes_gives_its_camera() {
    let (folder, scene) = saved(&ball(300, 12, [0.6, 0.4, 0.3]));
    // igsr's tests hold its writer to the same file.
    let written = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cameras.json");
    let own = folder.join("own.json");
    write_cameras(&own, &[camera()]);
    let from =
        |cameras: &Path| draw(&scene, &format!("--camera 0 --cameras {}", cameras.display()));
    let ((seen, _), (expected, _)) = (from(&written), from(&own));
    assert_lit(&expected);
    assert!(seen.apart(&expected).0 <= 1, "off by {:?}", seen.apart(&expected));
}

#[test]
fn every_format_opens_and_shows_the_scene() {
    let folder = Folder::new();
    let file = ball(400, 13, [0.3, 0.6, 0.5]);
    let draw = |name: &str| {
        write(&folder.join(name), &file);
        draw(&folder.join(name), "--size 120x90").0
    };
    let expected = draw("scene.ply");
    assert_lit(&expected);
    // Largest mean differences, in 255ths: of .splat, which has no view-dependent color, and of the
    // others, which round.
    let formats = [
        ("a.splat", 12.0),
        ("a.spz", 3.0),
        ("a.sog", 3.0),
        ("a.compressed.ply", 3.0),
        ("a.glb", 0.2),
        ("a.gltf", 0.2),
    ];
    for (name, most) in formats {
        let (_, mean) = draw(name).apart(&expected);
        println!("{name}: {mean:.3} on average");
        assert!(mean <= most, "{name} is off by {mean} on average");
    }
}

/// Bounds on the difference of each renderer from the rasterizer, in 255ths (docs/guides/viewing.md).
const OFF: [(&str, f64, f64); 2] = [("rasterize", 1.0, 0.1), ("blend", 3.0, 0.5)];

#[test]
fn both_renderers_agree_with_the_rasterizer_and_are_timed() {
    let (_folder, scene) = saved(&ball(3000, 11, [0.5, 0.4, 0.6]));
    for (way, most, mean) in OFF {
        let options = "--time 2 --size 161x120 --background 0.2,0.4,0.6 --draw";
        let output = run(command(&scene, options).arg(way));
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let off: Vec<f64> = text
            .lines()
            .find(|line| line.starts_with("off the rasterizer's picture"))
            .unwrap_or_else(|| panic!("no comparison in: {text}"))
            .split(|c: char| !c.is_ascii_digit() && c != '.')
            .filter_map(|word| word.parse().ok())
            .collect();
        println!("{text}");
        assert!(off.len() == 3 && off[0] <= most && off[2] <= mean, "{way}: {text}");
        let lines = text.lines().filter(|line| line.starts_with(' '));
        let (stages, times): (Vec<&str>, Vec<f64>) = lines
            .filter_map(|line| line.trim().split_once(' '))
            .filter_map(|(stage, ms)| Some((stage, ms.trim().parse::<f64>().ok()?)))
            .unzip();
        let own = if way == "blend" { &["blend"][..] } else { &["bin", "rasterize", "canvas"] };
        let expected = [&["project", "sort"], own, &["compose", "rest", "whole", "least"]].concat();
        assert_eq!(stages, expected, "{way}");
        assert!(times.iter().all(|&ms| ms >= 0.0), "stages take more than the whole: {text}");
    }
}

#[test]
fn the_first_view_of_a_run_s_models_is_the_first_photo_s() {
    let folder = Folder::new();
    let file = ball(300, 18, [0.6, 0.4, 0.3]);
    let scenes = ["out/scene.ply", "out/rounds/0/scene.ply", "out/checkpoints/whole.npz"];
    write(&folder.join(scenes[0]), &file);
    write(&folder.join(scenes[1]), &file);
    std::fs::create_dir_all(folder.join("out/checkpoints")).expect("folder");
    write_checkpoint(&folder.join(scenes[2]), &file, ([0.0; 3], 1.0));
    let other = Camera { viewmat: DMat4::from_translation(DVec3::Z * 6.0), ..camera() };
    write_cameras(&folder.join("out/cameras.json"), &[camera(), other]);
    let report = r#"{"test": {"protocol": {"background": [1.0, 0.5, 0.25]}}}"#;
    std::fs::write(folder.join("out/report.json"), report).expect("report");
    let draw = |scene: &str, options: &str| {
        draw(&folder.join(scene), &format!("--size 120x80 {options}")).0
    };
    let expected = picture(&drawn(&file, &camera(), [1.0, 0.5, 0.25]));
    for scene in scenes.iter().chain(&["out"]) {
        let off = draw(scene, "").apart(&expected).0;
        assert!(off <= 1, "{scene} is off by {off}");
    }
    // Options have priority.
    let black = picture(&drawn(&file, &other, [0.0; 3]));
    let off = draw(scenes[1], "--camera 1 --background black").apart(&black).0;
    assert!(off <= 1, "off by {off}");
    assert!(draw(scenes[1], "--fov 120").apart(&expected).0 > 30, "--fov does nothing");
}

#[test]
fn a_scene_without_cameras_is_seen_from_above_its_ground() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    // A red floor that faces +x, and a green pole on it.
    let mut file = ball(0, 0, [0.0; 3]);
    let mut add = |at: [f32; 3], scales: [f32; 3], color: [f32; 3]| {
        file.splats.means.push(at);
        file.splats.quats.push([1.0, 0.0, 0.0, 0.0]);
        file.splats.scales.push(scales);
        file.splats.opacities.push(5.0);
        file.splats.sh.push(color.map(|v| (v - 0.5) / 0.282));
        file.splats.sh.extend([[0.0; 3]; 3]);
    };
    for y in -8..=8 {
        for z in -8..=8 {
            let at = [0.0, 0.1 * y as f32, 0.1 * z as f32];
            add(at, [-6.0, -2.5, -2.5], [1.0, 0.0, 0.0]);
        }
    }
    for x in 1..=9 {
        add([0.05 * x as f32, 0.0, 0.0], [-2.6; 3], [0.0, 1.0, 0.0]);
    }
    write(&scene, &file);
    let (picture, _) = draw(&scene, "--size 180x180");
    let middle = |channel: usize| {
        let is_it =
            |i: &usize| picture.rgb[3 * i + channel] > 128 && picture.rgb[3 * i + 1 - channel] < 90;
        let rows: Vec<usize> = (0..180 * 180).filter(is_it).map(|i| i / 180).collect();
        assert!(rows.len() > 20, "channel {channel} is seen at {} pixels", rows.len());
        rows.iter().sum::<usize>() as f64 / rows.len() as f64
    };
    assert!(middle(1) + 5.0 < middle(0), "the pole is not above the floor");
}

/// "N of M splats, in C of D cells; H are in memory.": all numbers.
fn numbers(notes: &str) -> Vec<usize> {
    let line = notes.lines().find(|line| line.contains("cells")).expect("a line of cells");
    line.split(|c: char| !c.is_ascii_digit()).filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn levels_are_drawn_within_a_budget_and_look_better_with_more() {
    let folder = Folder::new();
    let levels = write_in_levels(&folder, &ball(3000, 5, [0.6, 0.4, 0.3]));
    // One view for all: the coarse scenes have another center.
    let cameras = folder.join("cameras.json");
    write_cameras(&cameras, &[camera()]);
    let draw = |scene: &Path, options: &str| {
        draw(scene, &format!("--size 120x90 --cameras {} {options}", cameras.display()))
    };
    let (whole, _) = draw(&folder.join("scene.ply"), "");
    let mut last = f64::INFINITY;
    for budget in [300usize, 1500, 4000] {
        let (picture, notes) = draw(&levels, &format!("--budget {budget}"));
        let [drawn, all, cells, of, held] = numbers(&notes)[..] else { panic!("five numbers") };
        assert!(drawn <= budget && held <= budget, "{drawn} and {held} of {budget}");
        assert!(drawn * 2 > budget.min(3000), "{drawn} of {budget}");
        assert_eq!((all, cells), (3000, of));
        let off = picture.apart(&whole).1;
        assert!(off < last, "{budget} splats are off by {off}, fewer by {last}");
        last = off;
    }
    // The budget has room for all, except for SOG's rounding.
    assert!(last < 2.0, "{last}");
    let (index, _) = draw(&levels.join("lod-meta.json"), "");
    assert!(index.apart(&whole).1 < 2.0);
}
