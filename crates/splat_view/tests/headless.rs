//! Pictures without a window.

mod common;

use std::path::Path;

use common::{Folder, ball, program, read_png, refused, run, said, write, write_cameras};
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
        let output =
            run(&[&scene, &"--screenshot", &out, &"--camera", &"0", &"--backend", &backend]);
        // Mesa's, of a desktop that pictures do not need.
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
    run(&[&scene, &"--screenshot", &out, &"--camera", &"0", &"--backend", &"cpu"]);
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
    let (scene, out) = (folder.join("scene.splat"), folder.join("out.png"));
    write(&scene, &ball(300, 3, [0.3, 0.5, 0.7]));
    let draw = |arguments: &[&dyn AsRef<std::ffi::OsStr>]| {
        let mut all: Vec<&dyn AsRef<std::ffi::OsStr>> =
            vec![&scene, &"--screenshot", &out, &"--size", &"90x60", &"--backend", &"cpu"];
        all.extend(arguments);
        run(&all);
        read_png(&out)
    };
    let first = draw(&[]);
    assert_eq!(first.size, [90, 60]);
    assert!(draw(&[&"--orbit", &"40"]).apart(&first).1 > 2.0, "an orbit changes nothing");
    assert!(draw(&[&"--orbit", &"360"]).apart(&first).0 <= 1, "a full turn does not return");
    assert!(draw(&[&"--up", &"z"]).apart(&first).1 > 2.0, "up changes nothing");
    let corner = &draw(&[&"--background", &"0.2,0.4,1"]).rgb[..3];
    assert_eq!(corner, [51, 102, 255]);
    // Seen from farther away with the lens narrower, all of it is in the picture, and larger than a dot.
    let lit = first.rgb.chunks_exact(3).filter(|p| p.iter().any(|&v| v > 20)).count();
    assert!((90 * 60 / 10..90 * 60).contains(&lit), "{lit} pixels are lit");
}

#[test]
fn frames_of_a_full_turn_are_all_different() {
    let folder = Folder::new();
    let (scene, frames) = (folder.join("scene.ply"), folder.join("frames"));
    write(&scene, &ball(200, 4, [0.5, 0.3, 0.6]));
    run(&[
        &scene,
        &"--frames",
        &frames,
        &"--orbit",
        &"4",
        &"--size",
        &"60x40",
        &"--backend",
        &"cpu",
    ]);
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
    let draw = |scene: &Path| {
        let out = scene.with_extension("png");
        let output = run(&[&scene, &"--screenshot", &out, &"--camera", &"0", &"--backend", &"cpu"]);
        (read_png(&out), said(&output))
    };
    let (dirty_picture, notes) = draw(&dirty);
    assert!(draw(&clean).0 == dirty_picture, "broken splats change the picture");
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
        let output = program().arg(&scene).arg("--screenshot").arg(&out).output().expect("start");
        refused(&output, &[name, word]);
        assert!(!out.exists(), "{name} left a picture");
        // The same where a window was asked for: it is said before any is opened.
        refused(&program().arg(&scene).output().expect("start"), &[name, word]);
    }
    let nothing = program().arg(folder.join("no.ply")).output().expect("start");
    refused(&nothing, &["no.ply", "cannot be opened"]);
    let none = Folder::new();
    let no_scene = program().arg(&none.0).args(["--time", "1"]).output().expect("start");
    refused(&no_scene, &["holds no scene.ply"]);
}

#[test]
fn arguments_that_make_no_sense_are_refused_in_one_message() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(10, 7, [0.5; 3]));
    let out = folder.join("out.png");
    let out = out.to_str().expect("text");
    let bad: [(&[&str], &[&str]); 12] = [
        (&["--size", "0x3"], &["--size", "800x600"]),
        (&["--size", "99999x3"], &["--size"]),
        (&["--camera", "0"], &["--camera", "--cameras"]),
        (&["--frames", "x"], &["--screenshot, --frames"]),
        (&["--fov", "NaN"], &["--fov"]),
        (&["--background", "1,2"], &["--background"]),
        (&["--backend", "cuda"], &["--backend", "cuda"]),
        (&["--draw", "blend"], &["--draw", "--time"]),
        (&["--draw", "paint"], &["--draw", "paint"]),
        (&["--nonsense"], &["--nonsense"]),
        (&["--cameras", out], &["out.png"]),
        (&["another.ply"], &["SCENE", "another.ply"]),
    ];
    for (arguments, words) in bad {
        let mut command = program();
        command.arg(&scene).args(["--screenshot", out]).args(arguments);
        refused(&command.output().expect("start"), words);
    }
    let wrong = program().arg(&scene).args(["--screenshot", "a.jpg"]).output().expect("start");
    refused(&wrong, &["--screenshot", ".png or .exr"]);
    let frames = program().arg(&scene).args(["--frames", out]).output().expect("start");
    refused(&frames, &["--orbit"]);
}

#[test]
fn without_an_adapter_the_cpu_draws_and_gpu_is_refused() {
    let folder = Folder::new();
    let (scene, out) = (folder.join("scene.ply"), folder.join("out.png"));
    write(&scene, &ball(50, 8, [0.5; 3]));
    let command = |backend: &str| {
        let mut command = program();
        command.env("VK_DRIVER_FILES", "/nothing").env("VK_ICD_FILENAMES", "/nothing");
        command.arg(&scene).arg("--screenshot").arg(&out);
        command.args(["--size", "40x30", "--backend", backend]).output().expect("start")
    };
    // Metal and DX12 need no file that could be hidden.
    if cfg!(target_os = "linux") {
        refused(&command("gpu"), &["backend gpu", "no Vulkan"]);
        let drawn = command("auto");
        assert!(drawn.status.success(), "{}", said(&drawn));
        assert!(said(&drawn).contains("the CPU draws"), "{}", said(&drawn));
        assert_eq!(read_png(&out).size, [40, 30]);
    }
}

#[test]
fn without_a_display_an_error_message_says_what_to_do() {
    if cfg!(target_os = "linux") {
        let folder = Folder::new();
        let scene = folder.join("scene.ply");
        write(&scene, &ball(10, 9, [0.5; 3]));
        let output = program().arg(&scene).output().expect("start");
        refused(&output, &["no display answers", "WAYLAND_DISPLAY nor DISPLAY", "--screenshot"]);
        assert!(!said(&output).contains(".rs"), "winit's source is named: {}", said(&output));
        let nobody = program().env("DISPLAY", ":none").arg(&scene).output().expect("start");
        refused(&nobody, &["no display answers at DISPLAY=:none", "--screenshot"]);
    }
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
    let draw = |name: &str| {
        let out = folder.join(&format!("{name}.png"));
        let arguments = ["--size", "80x60", "--backend", "cpu"];
        let [a, b, c, d] = arguments;
        run(&[&folder.join(name), &"--screenshot", &out, &a, &b, &c, &d]);
        read_png(&out)
    };
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
        let mut command = program();
        command.arg(&path).args(["--screenshot", "x.png", "--backend", "cpu"]);
        refused(&command.output().expect("start"), &["checkpoint.npz", "origin"]);
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
    let draw = |scene: &Path, more: &[&str]| {
        let out = scene.with_extension("png");
        let mut arguments: Vec<&dyn AsRef<std::ffi::OsStr>> =
            vec![&scene, &"--screenshot", &out, &"--size", &"90x60", &"--backend", &"cpu"];
        arguments.extend(more.iter().map(|word| word as &dyn AsRef<std::ffi::OsStr>));
        run(&arguments);
        read_png(&out)
    };
    let (large, small_one) = (draw(&scene, &[]), draw(&small, &[]));
    assert!(large.apart(&small_one).1 < 0.1, "off by {:?}", large.apart(&small_one));
    // What was asked for stays.
    assert!(draw(&small, &["--near", "0.01"]).rgb.iter().all(|&v| v == 0), "near is nothing");
}

#[test]
fn frames_larger_than_any_texture_are_refused() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(10, 17, [0.5; 3]));
    let mut command = program();
    command.arg(&scene).args(["--time", "1", "--size", "9000x4"]);
    refused(&command.output().expect("start"), &["--size", "up to 8192", "9000x4"]);
}

/// The camera of a headless picture, as a folder of cameras has it.
fn from_camera(scene: &Path, cameras: &Path, number: &str) -> common::Picture {
    let out = scene.with_extension("png");
    let arguments: [&dyn AsRef<std::ffi::OsStr>; 9] = [
        &scene,
        &"--screenshot",
        &out,
        &"--backend",
        &"cpu",
        &"--cameras",
        &cameras,
        &"--camera",
        &number,
    ];
    run(&arguments);
    read_png(&out)
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
    let (seen, expected) = (from_camera(&scene, &written, "0"), from_camera(&scene, &own, "0"));
    assert!(expected.rgb.iter().any(|&v| v > 60), "the scene is dark");
    assert!(seen.apart(&expected).0 <= 1, "off by {:?}", seen.apart(&expected));
}

#[test]
fn other_cameras_are_refused_and_say_what_reads_them() {
    let folder = Folder::new();
    let scene = folder.join("scene.ply");
    write(&scene, &ball(10, 15, [0.5; 3]));
    let refuse = |cameras: &Path, words: &[&str]| {
        let mut command = program();
        command.arg(&scene).args(["--screenshot", "x.png", "--cameras"]).arg(cameras);
        refused(&command.output().expect("start"), words);
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
    // Nobody named them: the scene is shown without.
    let output = run(&[&scene, &"--screenshot", &folder.join("x.png"), &"--backend", &"cpu"]);
    assert!(said(&output).contains("no cameras are shown"), "{}", said(&output));
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
        let (scene, out) = (folder.join(name), folder.join("out.png"));
        write(&scene, &file);
        run(&[&scene, &"--screenshot", &out, &"--size", &"120x90", &"--backend", &"cpu"]);
        read_png(&out)
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
        let output = run(&[
            &scene,
            &"--time",
            &"2",
            &"--size",
            &"161x120",
            &"--background",
            &"0.2,0.4,0.6",
            &"--draw",
            &way,
        ]);
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
    let draw = |scene: &Path, more: &[&str]| {
        let out = folder.join("out.png");
        let mut arguments: Vec<&dyn AsRef<std::ffi::OsStr>> =
            vec![&scene, &"--screenshot", &out, &"--size", &"120x80", &"--backend", &"cpu"];
        arguments.extend(more.iter().map(|word| word as &dyn AsRef<std::ffi::OsStr>));
        run(&arguments);
        read_png(&out)
    };
    let expected = bytes(&drawn_over(&file, &camera(), [1.0, 0.5, 0.25]));
    for scene in scenes.iter().chain(&["out"]) {
        let off = draw(&folder.join(scene), &[])
            .rgb
            .iter()
            .zip(&expected)
            .map(|(a, b)| a.abs_diff(*b))
            .max();
        assert!(off <= Some(1), "{scene} is off by {off:?}");
    }
    // What is asked for goes before.
    let black = bytes(&drawn(&file, &other));
    let asked = draw(&folder.join(scenes[1]), &["--camera", "1", "--background", "black"]);
    let off = asked.rgb.iter().zip(&black).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(off <= Some(1), "off by {off:?}");
    let wide = draw(&folder.join(scenes[1]), &["--fov", "120"]);
    assert!(wide.rgb.iter().zip(&expected).any(|(a, b)| a.abs_diff(*b) > 30), "--fov does nothing");
}

#[test]
fn a_scene_without_cameras_is_seen_from_above_its_ground() {
    let folder = Folder::new();
    let (scene, out) = (folder.join("scene.ply"), folder.join("out.png"));
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
    run(&[&scene, &"--screenshot", &out, &"--size", &"180x180", &"--backend", &"cpu"]);
    let picture = read_png(&out);
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
    let mut command = program();
    command.arg(&scene).arg("--frames").arg(&frames).args(["--orbit", "2", "--size", "20x20"]);
    command.args(["--backend", "cpu"]);
    // An empty one is as good as a new one.
    assert!(command.output().expect("start").status.success());
    let first = std::fs::read(frames.join("0000.png")).expect("a picture");
    refused(&command.output().expect("start"), &["frames", "is not empty", "--frames"]);
    assert_eq!(std::fs::read(frames.join("0000.png")).expect("a picture"), first);
    std::fs::write(folder.join("file"), "x").expect("file");
    let mut command = program();
    command.arg(&scene).arg("--frames").arg(folder.join("file"));
    command.args(["--orbit", "2", "--backend", "cpu"]);
    refused(&command.output().expect("start"), &["file", "cannot be made"]);
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
        refused(&running.wait_with_output().expect("output"), &[name, "is a pipe or a device"]);
    };
    for pipe in &pipes[..2] {
        refuse(&[pipe], &pipe.file_name().expect("a name").to_string_lossy());
    }
    refuse(&[&scene, &"--cameras", &pipes[2]], "cameras.json");
    refuse(&[&"/dev/zero"], "/dev/zero");
    // Cameras that nobody named are left out.
    let out = folder.join("out.png");
    let output = run(&[&scene, &"--screenshot", &out, &"--size", &"20x20", &"--backend", &"cpu"]);
    assert!(said(&output).contains("no cameras are shown"), "{}", said(&output));
}

#[test]
fn a_file_of_cameras_that_is_too_large_is_not_read() {
    let folder = Folder::new();
    let (scene, cameras) = (folder.join("scene.ply"), folder.join("cameras.json"));
    write(&scene, &ball(20, 21, [0.5; 3]));
    write_cameras(&cameras, &[camera()]);
    let file = std::fs::File::options().append(true).open(&cameras).expect("open");
    file.set_len((64 << 20) + 1).expect("size");
    let mut command = program();
    command.arg(&scene).args(["--screenshot", "x.png", "--cameras"]).arg(&cameras);
    refused(&command.output().expect("start"), &["cameras.json", "67108865 bytes"]);
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
fn numbers(output: &std::process::Output) -> Vec<usize> {
    let text = said(output);
    let line = text.lines().find(|line| line.contains("cells")).expect("a line of cells");
    line.split(|c: char| !c.is_ascii_digit()).filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn levels_are_drawn_within_a_budget_and_look_better_with_more() {
    let folder = Folder::new();
    let levels = ball_in_levels(&folder);
    let draw = |scene: &Path, more: &[&str]| {
        let out = folder.join("out.png");
        let size: [&dyn AsRef<std::ffi::OsStr>; 7] =
            [&scene, &"--screenshot", &out, &"--size", &"120x90", &"--backend", &"cpu"];
        let more = more.iter().map(|word| word as &dyn AsRef<std::ffi::OsStr>);
        let output = run(&size.into_iter().chain(more).collect::<Vec<_>>());
        (read_png(&out), output)
    };
    // One view for all: the coarse scenes have another middle.
    write_cameras(&folder.join("cameras.json"), &[camera()]);
    let cameras = folder.join("cameras.json");
    let cameras = ["--cameras", cameras.to_str().expect("a path")];
    let (whole, _) = draw(&folder.join("scene.ply"), &cameras);
    let mut last = f64::INFINITY;
    for budget in [300usize, 1500, 4000] {
        let text = budget.to_string();
        let words = [&cameras[..], &["--budget", &text]].concat();
        let (picture, output) = draw(&levels, &words);
        let [drawn, all, cells, of, held] = numbers(&output)[..] else { panic!("five numbers") };
        assert!(drawn <= budget && held <= budget, "{drawn} and {held} of {budget}");
        assert!(drawn * 2 > budget.min(3000), "{drawn} of {budget}");
        assert_eq!((all, cells), (3000, of));
        let off = picture.apart(&whole).1;
        assert!(off < last, "{budget} splats are off by {off}, fewer by {last}");
        last = off;
    }
    // The budget has room for all, but for what SOG rounds.
    assert!(last < 2.0, "{last}");
    let (index, _) = draw(&levels.join("lod-meta.json"), &cameras);
    assert!(index.apart(&whole).1 < 2.0);
}

#[test]
fn budgets_and_levels_that_cannot_be_are_told() {
    let folder = Folder::new();
    let levels = ball_in_levels(&folder);
    let out = folder.join("out.png");
    let said = |scene: &Path, more: &[&str], words: &[&str]| {
        let mut command = program();
        command.arg(scene).arg("--screenshot").arg(&out).args(["--backend", "cpu"]).args(more);
        refused(&command.output().expect("splat-view starts"), words);
        assert!(!out.exists());
    };
    said(&folder.join("scene.ply"), &["--budget", "100"], &["--budget", "igsr convert --lod"]);
    said(&levels, &["--budget", "0"], &["--budget", "from 1 to"]);
    said(&levels, &["--budget", "1"], &["--budget", "of 1 splats", "give more"]);
    std::fs::remove_dir_all(levels.join("0_0")).expect("gone");
    said(&levels, &[], &["0_0"]);
    std::fs::write(levels.join("lod-meta.json"), "{}").expect("an index");
    said(&levels, &[], &["lod-meta.json", "lodLevels"]);
}
