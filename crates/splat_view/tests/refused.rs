//! Errors of the program without a window.

mod common;

use std::path::Path;

use common::{
    Folder, ball, camera, cameras_json, command, draw, program, read_png, refused, refused_with,
    run, said, saved, write_cameras, write_checkpoint, write_in_levels,
};
use glam::{DMat4, DVec3};

#[test]
fn files_without_valid_splats_are_refused_in_one_message() {
    let folder = Folder::new();
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n\
                  property float x\nproperty float y\nproperty float z\nend_header\n";
    let codes =
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty \x1b]0;t\x07 x\n";
    let bad: [(&str, &[u8], &str); 6] = [
        ("codes.ply", codes, r"\u{1b}]0;t\u{7}"),
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
    let mut file = ball(10, 14, [0.5; 3]);
    for origin in [f64::NAN, f64::INFINITY] {
        file.origin[1] = origin;
        let path = folder.join("checkpoint.npz");
        write_checkpoint(&path, &file, ([0.0; 3], 1.0));
        refused(&mut command(&path, "--screenshot x.png"), &["checkpoint.npz", "origin"]);
    }
    refused(&mut command(&folder.join("no.ply"), ""), &["no.ply", "cannot be opened"]);
    refused(&mut command(&Folder::new().0, "--time 1"), &["holds no scene.ply"]);
}

#[test]
fn invalid_arguments_are_refused_in_one_message() {
    let (folder, scene) = saved(&ball(10, 7, [0.5; 3]));
    let out = folder.join("out.png");
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
    // Larger than any texture.
    refused(&mut command(&scene, "--time 1 --size 9000x4"), &["--size", "up to 8192", "9000x4"]);
}

// Metal and DX12 need no file that could be hidden.
#[cfg(target_os = "linux")]
#[test]
fn without_an_adapter_the_cpu_draws_and_gpu_is_refused() {
    let (folder, scene) = saved(&ball(50, 8, [0.5; 3]));
    let out = folder.join("out.png");
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
fn without_a_display_the_error_message_suggests_screenshot() {
    let (_folder, scene) = saved(&ball(10, 9, [0.5; 3]));
    let output = command(&scene, "").output().expect("start");
    refused_with(&output, &["no display was found", "WAYLAND_DISPLAY nor DISPLAY", "--screenshot"]);
    assert!(!said(&output).contains(".rs"), "winit's source is named: {}", said(&output));
    let words = ["no display was found at DISPLAY=:none", "--screenshot"];
    refused(command(&scene, "").env("DISPLAY", ":none"), &words);
}

#[test]
fn cameras_in_other_formats_and_very_large_files_are_refused() {
    let (folder, scene) = saved(&ball(10, 15, [0.5; 3]));
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
    let good = cameras_json(&[camera()]);
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
        (cameras_json(&[]), &["has no cameras"]),
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
    std::fs::write(&file, good).expect("cameras");
    let large = std::fs::File::options().append(true).open(&file).expect("open");
    large.set_len((64 << 20) + 1).expect("size");
    refuse(&file, &["cameras.json", "67108865 bytes"]);
}

#[test]
fn frames_need_an_empty_folder() {
    let (folder, scene) = saved(&ball(20, 19, [0.5; 3]));
    let frames = folder.join("frames");
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
    refused(&mut to(&folder.join("file")), &["file", "cannot be created"]);
}

#[cfg(target_os = "linux")]
#[test]
fn pictures_that_memory_cannot_hold_are_refused() {
    let (folder, scene) = saved(&ball(20, 21, [0.5; 3]));
    let mut command = std::process::Command::new("sh");
    command.args(["-c", "ulimit -v 3000000 && exec \"$@\"", "sh"]);
    command.arg(program().get_program()).arg(&scene);
    command.args(["--backend", "cpu", "--size", "16384x16384", "--screenshot"]);
    refused(command.arg(folder.join("a.png")), &["16384 x 16384", "GB"]);
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_at_once() {
    use std::time::{Duration, Instant};
    let (folder, scene) = saved(&ball(20, 20, [0.5; 3]));
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
fn wrong_budgets_and_broken_levels_are_refused() {
    let folder = Folder::new();
    let levels = write_in_levels(&folder, &ball(3000, 5, [0.6, 0.4, 0.3]));
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
