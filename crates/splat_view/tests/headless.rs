//! Pictures without a window.

mod common;

use std::path::Path;

use common::{
    Folder, Picture, ball, command, draw, program, read_png, refused, refused_with, run, said,
    write, write_cameras,
};
use glam::{DMat4, DVec3};
use splat_render::cpu::Cpu;
use splat_render::io::SplatFile;
use splat_render::levels::write_levels;
use splat_render::{Camera, Image, ProjectOptions, Stages};

/// A camera 4 units off, with its middle elsewhere than the picture's.
fn camera() -> Camera {
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

fn drawn(file: &SplatFile, camera: &Camera) -> Image<f32> {
    drawn_over(file, camera, [0.0; 3])
}

fn drawn_over(file: &SplatFile, camera: &Camera, background: [f32; 3]) -> Image<f32> {
    let params = file.splats.params(4);
    let projected = Cpu.project(&params, camera, &ProjectOptions::default()).expect("project");
    Cpu.rasterize(&projected, background).expect("rasterize")
}

fn bytes(image: &Image<f32>) -> Vec<u8> {
    image.color.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}

#[test]
fn a_capture_s_camera_draws_what_the_rasterizer_draws_on_cpu_and_gpu() {
    let folder = Folder::new();
    let (scene, out) = (folder.join("scene.ply"), folder.join("out.png"));
    let file = ball(300, 1, [0.6, 0.4, 0.3]);
    write(&scene, &file);
    write_cameras(&folder.join("cameras.json"), &[camera()]);
    let expected = bytes(&drawn(&file, &camera()));
    for backend in ["cpu", "gpu"] {
        let mut command = command(&scene, &format!("--camera 0 --backend {backend}"));
        let output = run(command.arg("--screenshot").arg(&out));
        // Mesa's error message on machines without a desktop.
        assert!(!said(&output).contains("XDG_RUNTIME_DIR"), "{}", said(&output));
        let picture = read_png(&out);
        assert_eq!(picture.size, [120, 80]);
        let off = picture.rgb.iter().zip(&expected).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(off <= Some(1), "{backend} is off by {off:?}");
    }
    assert!(expected.iter().any(|&v| v > 60), "the scene is dark");
}

#[test]
fn exr_holds_color_alpha_and_expected_depth() {
    let folder = Folder::new();
    let (scene, out) = (folder.join("scene.ply"), folder.join("out.exr"));
    let file = ball(200, 2, [0.5; 3]);
    write(&scene, &file);
    write_cameras(&folder.join("cameras.json"), &[camera()]);
    run(command(&scene, "--camera 0 --backend cpu --screenshot").arg(&out));
    let image = exr::prelude::read_first_flat_layer_from_file(&out).expect("an EXR");
    let names: Vec<String> =
        image.layer_data.channel_data.list.iter().map(|c| c.name.to_string()).collect();
    assert_eq!(names, ["A", "B", "G", "R", "Z"]);
    let channel = |i: usize| -> Vec<f32> {
        image.layer_data.channel_data.list[i].sample_data.values_as_f32().collect()
    };
    let expected = drawn(&file, &camera());
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
fn sizes_orbits_and_backgrounds_are_as_asked() {
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
    let folder = Folder::new();
    let (scene, frames) = (folder.join("scene.ply"), folder.join("frames"));
    write(&scene, &ball(200, 4, [0.5, 0.3, 0.6]));
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
fn files_that_hold_no_splats_are_refused_in_one_message() {
    let folder = Folder::new();
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n\
                  property float x\nproperty float y\nproperty float z\nend_header\n";
    let bad: [(&str, &[u8], &str); 5] = [
        ("empty.ply", b"", "is empty"),
        ("short.ply", b"0123456789", "ply"),
        ("photo.ply", b"\xff\xd8\xff\xe0\x00\x10JFIF\x00\x01\x01\x00\x00\x01\x00\x01", "ply"),
        ("claims.ply", header.as_bytes(), "claims.ply"),
        ("checkpoint.npz", b"PK\x03\x04 but not more", "checkpoint"),
    ];
    for (name, bytes, word) in bad {
        let scene = folder.join(name);
        std::fs::write(&scene, bytes).expect("file");
        let out = folder.join("out.png");
        refused(command(&scene, "--screenshot").arg(&out), &[name, word]);
        assert!(!out.exists(), "{name} left a picture");
        // The same before a window opens.
        refused(&mut command(&scene, ""), &[name, word]);
    }
    refused(&mut command(&folder.join("no.ply"), ""), &["no.ply", "cannot be opened"]);
    refused(&mut command(&Folder::new().0, "--time 1"), &["holds no scene.ply"]);
}

#[test]
fn arguments_that_make_no_sense_are_refused_in_one_message() {
    let folder = Folder::new();
    let (scene, out) = (folder.join("scene.ply"), folder.join("out.png"));
    write(&scene, &ball(10, 7, [0.5; 3]));
    let bad: [(&str, &[&str]); 12] = [
        ("--size 0x3", &["--size", "800x600"]),
        ("--size 99999x3", &["--size"]),
        ("--camera 0", &["--camera", "--cameras"]),
        ("--frames x", &["--screenshot, --frames"]),
        ("--fov NaN", &["--fov"]),
        ("--background 1,2", &["--background"]),
        ("--backend cuda", &["--backend", "cuda"]),
        ("--draw blend", &["--draw", "--time"]),
        ("--draw paint", &["--draw", "paint"]),
        ("--nonsense", &["--nonsense"]),
        ("--cameras out.png", &["out.png"]),
        ("another.ply", &["SCENE", "another.ply"]),
    ];
    for (options, words) in bad {
        refused(command(&scene, options).arg("--screenshot").arg(&out), words);
    }
    refused(&mut command(&scene, "--screenshot a.jpg"), &["--screenshot", ".png or .exr"]);
    refused(command(&scene, "--frames").arg(&out), &["--orbit"]);
}

// Metal and DX12 need no file that could be hidden.
#[cfg(target_os = "linux")]
#[test]
fn without_an_adapter_the_cpu_draws_and_gpu_is_refused() {
    let folder = Folder::new();
    let (scene, out) = (folder.join("scene.ply"), folder.join("out.png"));
    write(&scene, &ball(50, 8, [0.5; 3]));
    let hidden = |backend: &str| {
        let mut command = command(&scene, "--size 40x30 --backend");
        command.env("VK_DRIVER_FILES", "/nothing").env("VK_ICD_FILENAMES", "/nothing");
        command.args([backend, "--screenshot"]).arg(&out);
        command
    };
    refused(&mut hidden("gpu"), &["backend gpu", "no Vulkan"]);
    let drawn = run(&mut hidden("auto"));
    assert!(said(&drawn).contains("the CPU draws"), "{}", said(&drawn));
    assert_eq!(read_png(&out).size, [40, 30]);
}

#[cfg(target_os = "linux")]
#[test]
fn without_a_display_an_error_message_says_what_to_do() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(10, 9, [0.5; 3]));
    let output = command(&scene, "").output().expect("start");
    refused_with(&output, &["no display answers", "WAYLAND_DISPLAY nor DISPLAY", "--screenshot"]);
    assert!(!said(&output).contains(".rs"), "winit's source is named: {}", said(&output));
    let words = ["no display answers at DISPLAY=:none", "--screenshot"];
    refused(command(&scene, "").env("DISPLAY", ":none"), &words);
}

/// A checkpoint as numpy's savez writes it.
fn write_checkpoint(path: &Path, file: &SplatFile) {
    use std::io::Write;
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
    member("means", "<f4", &format!("{n}, 3"), floats(s.means.as_flattened()));
    member("quats", "<f4", &format!("{n}, 4"), floats(s.quats.as_flattened()));
    member("scales", "<f4", &format!("{n}, 3"), floats(s.scales.as_flattened()));
    member("opacities", "<f4", &format!("{n},"), floats(&s.opacities));
    member("sh", "<f4", &format!("{n}, {}, 3", s.stride()), floats(s.sh.as_flattened()));
    let origin = file.origin.iter().flat_map(|v| v.to_le_bytes()).collect();
    member("origin", "<f8", "3,", origin);
    zip.finish().expect("zip");
}

#[test]
fn a_fit_s_folder_shows_its_checkpoint_as_it_shows_the_same_scene() {
    let folder = Folder::new();
    let mut file = ball(150, 10, [0.4, 0.6, 0.3]);
    // Means are relative to an origin that f32 could not hold them at.
    file.origin = [1e7, -2e7, 5.0];
    write(&folder.join("a/scene.ply"), &file);
    std::fs::create_dir_all(folder.join("b")).expect("folder");
    write_checkpoint(&folder.join("b/checkpoint.npz"), &file);
    let draw = |name: &str| draw(&folder.join(name), "--size 80x60").0;
    let scene = draw("a");
    assert!(scene == draw("b"));
    assert!(scene.rgb.iter().any(|&v| v > 60), "nothing is seen so far from the world's origin");
}

#[test]
fn a_checkpoint_whose_origin_is_not_finite_is_refused() {
    let folder = Folder::new();
    let path = folder.join("checkpoint.npz");
    for origin in [f64::NAN, f64::INFINITY] {
        let mut file = ball(10, 14, [0.5; 3]);
        file.origin[1] = origin;
        write_checkpoint(&path, &file);
        let mut command = command(&path, "--screenshot x.png --backend cpu");
        refused(&mut command, &["checkpoint.npz", "origin"]);
    }
}

#[test]
fn a_small_scene_is_seen_as_a_large_one_is() {
    let folder = Folder::new();
    let (scene, small) = (folder.join("scene.ply"), folder.join("small.ply"));
    let mut file = ball(300, 16, [0.6, 0.4, 0.3]);
    write(&scene, &file);
    let factor = 2.5e-3f32;
    file.splats.means.as_flattened_mut().iter_mut().for_each(|v| *v *= factor);
    file.splats.scales.as_flattened_mut().iter_mut().for_each(|v| *v += factor.ln());
    write(&small, &file);
    let draw = |scene: &Path, options: &str| draw(scene, &format!("--size 90x60 {options}")).0;
    let (large, small_one) = (draw(&scene, ""), draw(&small, ""));
    assert!(large.apart(&small_one).1 < 0.1, "off by {:?}", large.apart(&small_one));
    // An explicit near plane stays.
    assert!(draw(&small, "--near 0.01").rgb.iter().all(|&v| v == 0), "near is nothing");
}

#[test]
fn frames_larger_than_any_texture_are_refused() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(10, 17, [0.5; 3]));
    let mut command = command(&scene, "--time 1 --size 9000x4");
    refused(&mut command, &["--size", "up to 8192", "9000x4"]);
}

#[test]
fn the_file_that_igsr_writes_gives_its_camera() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(300, 12, [0.6, 0.4, 0.3]));
    // igsr's tests hold its writer to the same file.
    let written = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cameras.json");
    let own = folder.join("own.json");
    write_cameras(&own, &[camera()]);
    let from =
        |cameras: &Path| draw(&scene, &format!("--camera 0 --cameras {}", cameras.display()));
    let ((seen, _), (expected, _)) = (from(&written), from(&own));
    assert!(expected.rgb.iter().any(|&v| v > 60), "the scene is dark");
    assert!(seen.apart(&expected).0 <= 1, "off by {:?}", seen.apart(&expected));
}

#[test]
fn other_cameras_are_refused_and_say_what_reads_them() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(10, 15, [0.5; 3]));
    let refuse = |cameras: &Path, words: &[&str]| {
        refused(command(&scene, "--screenshot x.png --cameras").arg(cameras), words);
    };
    let model = folder.join("colmap/sparse/0");
    std::fs::create_dir_all(&model).expect("folder");
    std::fs::write(model.join("cameras.bin"), [1; 64]).expect("cameras.bin");
    let others = ["igsr view", "igsr export"];
    refuse(&folder.join("colmap"), &[&["colmap", "holds no cameras.json"], &others[..]].concat());
    refuse(
        &model.join("cameras.bin"),
        &[&["cameras.bin", "not a cameras.json"], &others[..]].concat(),
    );
    refuse(&folder.join("nothing"), &["nothing", "does not exist"]);

    let file = folder.join("cameras.json");
    let good = common::cameras_json(&[camera()]);
    let bad = [
        // nerfstudio's, whose lens distorts.
        (good.replace("PINHOLE", "OPENCV"), &["OPENCV", "igsr view", "igsr export"][..]),
        // instant-ngp's.
        (good.replace("\"camera_model\": \"PINHOLE\", ", ""), &["camera_model", "igsr view"]),
        // INRIA's.
        ("[{\"id\": 0, \"fx\": 9.0}]".to_owned(), &["cameras.json", "igsr view"]),
        (good.replace("\"fl_x\"", "\"focal\""), &["fl_x"]),
        (good.replace("[[", "[[null, "), &["transform_matrix", "invalid"][1..]),
        (good.replace("\"w\": 120", "\"w\": 0"), &["0.png", "width"]),
        (good.replace("110", "-1"), &["0.png", "focal"]),
        (good[..good.len() / 2].to_owned(), &["cameras.json", "EOF"]),
        (common::cameras_json(&[]), &["has no cameras"]),
    ];
    for (text, words) in bad {
        std::fs::write(&file, text).expect("cameras");
        refuse(&file, words);
    }
    // Without --cameras, the scene is shown without cameras.
    let (_, notes) = draw(&scene, "");
    assert!(notes.contains("no cameras are shown"), "{notes}");
    let mut tilted = camera();
    tilted.viewmat = DMat4::from_scale(DVec3::splat(2.0)) * tilted.viewmat;
    write_cameras(&file, &[tilted]);
    refuse(&file, &["0.png", "rigid"]);
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
    assert!(expected.rgb.iter().any(|&v| v > 60), "the scene is dark");
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

/// Bounds on what the ways to draw in the window are off the rasterizer's picture, in 255ths;
/// docs/guides/viewing.md has them.
const OFF: [(&str, f64, f64); 2] = [("rasterize", 1.0, 0.1), ("blend", 3.0, 0.5)];

#[test]
fn both_ways_to_draw_agree_with_the_rasterizer_and_are_timed() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(3000, 11, [0.5, 0.4, 0.6]));
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
fn every_model_of_a_run_is_first_seen_as_a_photo_over_the_fit_s_background() {
    let folder = Folder::new();
    let file = ball(300, 18, [0.6, 0.4, 0.3]);
    let scenes = ["out/scene.ply", "out/rounds/0/scene.ply", "out/checkpoints/whole.npz"];
    write(&folder.join(scenes[0]), &file);
    write(&folder.join(scenes[1]), &file);
    std::fs::create_dir_all(folder.join("out/checkpoints")).expect("folder");
    write_checkpoint(&folder.join(scenes[2]), &file);
    let other = Camera { viewmat: DMat4::from_translation(DVec3::Z * 6.0), ..camera() };
    write_cameras(&folder.join("out/cameras.json"), &[camera(), other]);
    let report = r#"{"test": {"protocol": {"background": [1.0, 0.5, 0.25]}}}"#;
    std::fs::write(folder.join("out/report.json"), report).expect("report");
    let draw = |scene: &str, options: &str| {
        draw(&folder.join(scene), &format!("--size 120x80 {options}")).0
    };
    let picture = |rgb: Vec<u8>| Picture { size: [120, 80], rgb };
    let expected = picture(bytes(&drawn_over(&file, &camera(), [1.0, 0.5, 0.25])));
    for scene in scenes.iter().chain(&["out"]) {
        let off = draw(scene, "").apart(&expected).0;
        assert!(off <= 1, "{scene} is off by {off}");
    }
    // Options have priority.
    let black = picture(bytes(&drawn(&file, &other)));
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

#[test]
fn frames_go_into_no_folder_that_is_used() {
    let folder = Folder::new();
    let (scene, frames) = (folder.join("scene.ply"), folder.join("frames"));
    write(&scene, &ball(20, 19, [0.5; 3]));
    std::fs::create_dir_all(&frames).expect("folder");
    let to = |folder: &Path| {
        let mut command = command(&scene, "--orbit 2 --size 20x20 --backend cpu --frames");
        command.arg(folder);
        command
    };
    // An empty folder may be used.
    run(&mut to(&frames));
    let first = std::fs::read(frames.join("0000.png")).expect("a picture");
    refused(&mut to(&frames), &["frames", "is not empty", "--frames"]);
    assert_eq!(std::fs::read(frames.join("0000.png")).expect("a picture"), first);
    std::fs::write(folder.join("file"), "x").expect("file");
    refused(&mut to(&folder.join("file")), &["file", "cannot be made"]);
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_at_once() {
    use std::time::{Duration, Instant};
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(20, 20, [0.5; 3]));
    let pipes = ["pipe.ply", "pipe.npz", "cameras.json"].map(|name| folder.join(name));
    for pipe in &pipes {
        let made = std::process::Command::new("mkfifo").arg(pipe).status().expect("mkfifo");
        assert!(made.success());
    }
    let refuse = |arguments: &[&dyn AsRef<std::ffi::OsStr>], name: &str| {
        let mut command = program();
        command.args(arguments).args(["--screenshot", "x.png", "--backend", "cpu"]);
        command.stderr(std::process::Stdio::piped());
        let mut running = command.spawn().expect("start");
        let started = Instant::now();
        while running.try_wait().expect("wait").is_none() {
            if started.elapsed() > Duration::from_secs(20) {
                running.kill().expect("kill");
                panic!("{name} is waited for");
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        refused_with(
            &running.wait_with_output().expect("output"),
            &[name, "is a pipe or a device"],
        );
    };
    for pipe in &pipes[..2] {
        refuse(&[pipe], &pipe.file_name().expect("a name").to_string_lossy());
    }
    refuse(&[&scene, &"--cameras", &pipes[2]], "cameras.json");
    refuse(&[&"/dev/zero"], "/dev/zero");
    // Without --cameras, the pipe is skipped.
    let (_, notes) = draw(&scene, "--size 20x20");
    assert!(notes.contains("no cameras are shown"), "{notes}");
}

#[test]
fn a_file_of_cameras_that_is_too_large_is_not_read() {
    let folder = Folder::new();
    let (scene, cameras) = (folder.join("scene.ply"), folder.join("cameras.json"));
    write(&scene, &ball(20, 21, [0.5; 3]));
    write_cameras(&cameras, &[camera()]);
    let file = std::fs::File::options().append(true).open(&cameras).expect("open");
    file.set_len((64 << 20) + 1).expect("size");
    let mut command = command(&scene, "--screenshot x.png --cameras");
    refused(command.arg(&cameras), &["cameras.json", "67108865 bytes"]);
}

/// A ball of 3000 splats at three levels, in `levels` of the folder.
fn ball_in_levels(folder: &Folder) -> std::path::PathBuf {
    let (scene, levels) = (folder.join("scene.ply"), folder.join("levels"));
    write(&scene, &ball(3000, 5, [0.6, 0.4, 0.3]));
    std::fs::create_dir(&levels).expect("a folder");
    write_levels(&scene, &levels, 3, 200, &mut || true).expect("levels");
    levels
}

/// "N of M splats, in C of D cells; H are in memory.": all numbers.
fn numbers(notes: &str) -> Vec<usize> {
    let line = notes.lines().find(|line| line.contains("cells")).expect("a line of cells");
    line.split(|c: char| !c.is_ascii_digit()).filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn levels_are_drawn_within_a_budget_and_look_better_with_more() {
    let folder = Folder::new();
    let levels = ball_in_levels(&folder);
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
    // The budget has room for all, but for what SOG rounds.
    assert!(last < 2.0, "{last}");
    let (index, _) = draw(&levels.join("lod-meta.json"), "");
    assert!(index.apart(&whole).1 < 2.0);
}

#[test]
fn wrong_budgets_and_broken_levels_are_refused() {
    let folder = Folder::new();
    let levels = ball_in_levels(&folder);
    let out = folder.join("out.png");
    let refuse = |scene: &Path, options: &str, words: &[&str]| {
        let mut command = command(scene, options);
        refused(command.args(["--backend", "cpu", "--screenshot"]).arg(&out), words);
        assert!(!out.exists());
    };
    refuse(&folder.join("scene.ply"), "--budget 100", &["--budget", "igsr convert --lod"]);
    refuse(&levels, "--budget 0", &["--budget", "from 1 to"]);
    refuse(&levels, "--budget 1", &["--budget", "of 1 splats", "give more"]);
    std::fs::remove_dir_all(levels.join("0_0")).expect("gone");
    refuse(&levels, "", &["0_0"]);
    std::fs::write(levels.join("lod-meta.json"), "{}").expect("an index");
    refuse(&levels, "", &["lod-meta.json", "lodLevels"]);
}
