//! Every shader in every variant, translated to the languages of all drivers: SPIR-V for Vulkan, HLSL for
//! DX12's two compilers, MSL for Metal; the viewer's too. No adapter is needed. Debian's validators check
//! naga's output: `make test` installs them.

mod fxc_rules;
mod limits;
mod spirv_size;

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use naga::back::{hlsl, msl, spv};
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{
    Capabilities, ModuleInfo, ShaderStages, SubgroupOperationSet, ValidationFlags, Validator,
};
use naga::{Module, ShaderStage};
use splat_render::gpu::{ShaderVariant, shader_variants, shared_wgsl};

fn validator(subgroups: bool) -> Validator {
    let needs = if subgroups { Capabilities::SUBGROUP } else { Capabilities::empty() };
    let mut validator = Validator::new(ValidationFlags::all(), needs);
    if subgroups {
        validator.subgroup_stages(ShaderStages::COMPUTE);
        validator.subgroup_operations(SubgroupOperationSet::all());
    }
    validator
}

/// The viewer's shaders, listed with their prefixes.
fn viewer_variants() -> Vec<ShaderVariant> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../splat_view/src");
    let known = [("blend", shared_wgsl()), ("canvas", String::new()), ("compose", String::new())];
    let mut files: Vec<_> = fs::read_dir(&folder)
        .expect("the viewer's sources")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "wgsl"))
        .map(|path| path.file_stem().expect("a name").to_string_lossy().into_owned())
        .collect();
    files.sort();
    assert_eq!(files, known.each_ref().map(|(name, _)| *name));
    let variant = |(name, before): (&str, String)| {
        let text = fs::read_to_string(folder.join(format!("{name}.wgsl"))).expect("a shader");
        ShaderVariant {
            name: name.to_owned(),
            text: before + &text,
            subgroups: false,
            constants: Vec::new(),
        }
    };
    known.into_iter().map(variant).collect()
}

/// A shader as a pipeline has it: overrides resolved, one entry point.
struct Compiled {
    name: String,
    subgroups: bool,
    module: Module,
    info: ModuleInfo,
    stage: ShaderStage,
    entry: String,
}

fn compiled() -> Vec<Compiled> {
    let mut all = Vec::new();
    for variant in shader_variants().chain(viewer_variants()) {
        let ShaderVariant { name, text, subgroups, constants } = variant;
        let parsed = naga::front::wgsl::parse_str(&text)
            .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&text)));
        let info = validator(subgroups)
            .validate(&parsed)
            .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&text)));
        for entry in &parsed.entry_points {
            let values = constants.iter().map(|&(name, value)| (name.to_owned(), value)).collect();
            let at = Some((entry.stage, entry.name.as_str()));
            let (module, info) =
                naga::back::pipeline_constants::process_overrides(&parsed, &info, at, &values)
                    .unwrap_or_else(|e| panic!("{name}, {}: {e}", entry.name));
            all.push(Compiled {
                name: format!("{name}, {}", entry.name),
                subgroups,
                module: module.into_owned(),
                info: info.into_owned(),
                stage: entry.stage,
                entry: entry.name.clone(),
            });
        }
    }
    all
}

const POLICIES: BoundsCheckPolicies = BoundsCheckPolicies {
    index: BoundsCheckPolicy::Restrict,
    buffer: BoundsCheckPolicy::Restrict,
    image_load: BoundsCheckPolicy::Restrict,
    binding_array: BoundsCheckPolicy::Restrict,
};

fn spirv(shader: &Compiled) -> Vec<u8> {
    let options = spv::Options {
        // Subgroups came with Vulkan 1.1.
        lang_version: if shader.subgroups { (1, 3) } else { (1, 0) },
        bounds_check_policies: POLICIES,
        ..spv::Options::default()
    };
    let entry =
        spv::PipelineOptions { shader_stage: shader.stage, entry_point: shader.entry.clone() };
    let words = spv::write_vec(&shader.module, &shader.info, &options, Some(&entry))
        .unwrap_or_else(|e| panic!("{}: {e}", shader.name));
    words.into_iter().flat_map(u32::to_le_bytes).collect()
}

fn hlsl(shader: &Compiled, shader_model: hlsl::ShaderModel) -> String {
    let options = hlsl::Options { shader_model, ..hlsl::Options::default() };
    let entry = hlsl::PipelineOptions { entry_point: Some((shader.stage, shader.entry.clone())) };
    let mut text = String::new();
    let written = hlsl::Writer::new(&mut text, &options, &entry)
        .write(&shader.module, &shader.info, None)
        .unwrap_or_else(|e| panic!("{}: {e}", shader.name));
    assert!(written.entry_point_names.iter().all(Result::is_ok), "{}", shader.name);
    text
}

fn msl(shader: &Compiled) -> String {
    let options = msl::Options {
        // The oldest with subgroups, and the oldest that wgpu runs on.
        lang_version: if shader.subgroups { (2, 4) } else { (2, 0) },
        bounds_check_policies: POLICIES,
        ..msl::Options::default()
    };
    let entry = msl::PipelineOptions {
        entry_point: Some((shader.stage, shader.entry.clone())),
        ..msl::PipelineOptions::default()
    };
    let (text, written) = msl::write_string(&shader.module, &shader.info, &options, &entry)
        .unwrap_or_else(|e| panic!("{}: {e}", shader.name));
    assert!(written.entry_point_names.iter().all(Result::is_ok), "{}", shader.name);
    text
}

/// Runs a validator on standard input.
fn accepts(program: &str, arguments: &[&str], input: &[u8], name: &str) {
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap_or_else(|e| {
            panic!("{program} does not start ({e}); install spirv-tools and glslang-tools")
        });
    child.stdin.take().expect("a pipe").write_all(input).expect("input");
    let output = child.wait_with_output().expect("an end");
    assert!(
        output.status.success(),
        "{name}: {program} refuses it:\n{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn all_shaders_are_written_in_all_languages() {
    let shaders = compiled();
    // Three builds of the crate's 46 kernels, and the viewer's entry points.
    assert_eq!(shaders.len(), 3 * 46 + 6);
    for shader in &shaders {
        assert!(spirv(shader).starts_with(&0x0723_0203_u32.to_le_bytes()), "{}", shader.name);
        assert!(msl(shader).contains(&shader.entry), "{}", shader.name);
        assert!(hlsl(shader, hlsl::ShaderModel::V6_0).contains(&shader.entry), "{}", shader.name);
        // FXC knows no subgroups; only software adapters, which have Vulkan, are given them.
        if !shader.subgroups {
            let text = hlsl(shader, hlsl::ShaderModel::V5_1);
            assert!(text.contains(&shader.entry) && !text.contains("Wave"), "{}", shader.name);
        }
    }
}

#[test]
fn no_shader_has_what_fxc_refuses() {
    for shader in compiled() {
        let found = fxc_rules::breaches(&shader.module, &shader.info);
        assert!(found.is_empty(), "{}: {found:?}", shader.name);
    }
}

#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "spirv-val is installed on Linux only")]
fn the_spirv_is_valid() {
    for shader in compiled() {
        let target = if shader.subgroups { "vulkan1.1" } else { "vulkan1.0" };
        accepts("spirv-val", &["--target-env", target], &spirv(&shader), &shader.name);
    }
}

/// Rewrites naga's output that glslang does not accept: an initializer of a global that calls a function,
/// and a cast of zero to an array.
fn for_glslang(hlsl: &str) -> String {
    let lines = hlsl.lines().map(|line| match line.split_once(" = ") {
        Some((constant, call)) if line.starts_with("static const") => {
            let values = call.split_once('(').and_then(|(function, values)| {
                function.starts_with("Construct").then(|| values.strip_suffix(");"))?
            });
            values.map_or(line.to_owned(), |values| format!("{constant} = {{ {values} }};"))
        }
        Some((array, zero)) if zero.starts_with('(') && zero.ends_with("])0;") => {
            format!("{array};")
        }
        _ => line.to_owned(),
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// Not FXC, but a reader of HLSL that naga's authors did not write.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "glslangValidator is installed on Linux only")]
fn the_hlsl_compiles() {
    for shader in compiled().iter().filter(|shader| !shader.subgroups) {
        let text = for_glslang(&hlsl(shader, hlsl::ShaderModel::V5_1));
        let stage = match shader.stage {
            ShaderStage::Vertex => "vert",
            ShaderStage::Fragment => "frag",
            _ => "comp",
        };
        let arguments =
            ["-D", "-V", "--stdin", "-S", stage, "-e", &shader.entry, "-o", "/dev/null"];
        accepts("glslangValidator", &arguments, text.as_bytes(), &shader.name);
    }
}
