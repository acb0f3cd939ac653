//! Small files of every format, changed at random from fixed seeds: whatever comes of it is splats
//! or one sentence, soon and in little memory.
//!
//! `IGSR_FUZZ_CASES` is the number of cases per file; `make fuzz` sets it high.

use std::convert::identity;
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

use flate2::read::GzDecoder;
use splat_render::io::parse_splats;

use crate::hostile::MEMORY_MAX;
use crate::layouts::{gzip, ksplat, sog_entries, sog_of, spz_2, spz_4};
use crate::memory::peak_of;
use crate::scenes::{Numbers, bytes_of, folder, scene};

/// Cases per file in `make test`.
const CASES: usize = 400;
/// No case of these few hundred bytes may take longer, on a machine that is busy.
const TIME_MAX: Duration = Duration::from_secs(10);

/// Values that lengths and counts are changed to.
const EDGES: [u64; 10] = [0, 1, 2, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 32, u64::MAX];

/// Changes some bytes, a length, a digit, or the length of all.
pub fn mutate(bytes: &mut Vec<u8>, numbers: &mut Numbers) {
    for _ in 0..=numbers.below(3) {
        let at = numbers.below(bytes.len());
        match numbers.below(8) {
            0 | 1 if !bytes.is_empty() => bytes[at] ^= 1 << numbers.below(8),
            2 if !bytes.is_empty() => bytes[at] = numbers.bits() as u8,
            3 => bytes.truncate(at),
            4 | 5 => {
                // Most lengths are near the start, and aligned.
                let near = if numbers.below(2) == 0 { at } else { at % 128 };
                let width = [1, 2, 4, 8][numbers.below(4)];
                let at = near / width * width;
                let value = EDGES[numbers.below(EDGES.len())].to_le_bytes();
                for (byte, new) in bytes.iter_mut().skip(at).zip(&value[..width]) {
                    *byte = *new;
                }
            }
            6 => {
                let digits: Vec<usize> =
                    (0..bytes.len().min(4096)).filter(|&i| bytes[i].is_ascii_digit()).collect();
                if let Some(&at) = digits.get(numbers.below(digits.len())) {
                    let new = ["0", "-1", "9", "99999999", "1e999", "[]", "null"][numbers.below(7)];
                    bytes.splice(at..=at, new.bytes());
                }
            }
            _ => {
                // A piece is repeated or taken out.
                let end = (at + numbers.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                if numbers.below(2) == 0 {
                    bytes.splice(at..end, []);
                } else {
                    bytes.splice(at..at, piece);
                }
            }
        }
    }
}

/// Runs the cases of one file. `wrap` puts changed bytes into their container.
fn run(name: &str, seed_bytes: &[u8], wrap: impl Fn(Vec<u8>) -> Vec<u8>) {
    let cases = match std::env::var("IGSR_FUZZ_CASES") {
        Ok(cases) => cases.parse().expect("IGSR_FUZZ_CASES must be a number"),
        Err(_) => CASES,
    };
    let (mut read, mut refused) = (0, 0);
    for case in 0..cases {
        let mut bytes = seed_bytes.to_vec();
        if case > 0 {
            mutate(&mut bytes, &mut Numbers((case as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
        }
        let bytes = wrap(bytes);
        let started = Instant::now();
        let (result, peak) =
            peak_of(|| catch_unwind(AssertUnwindSafe(|| parse_splats(&bytes, Path::new(name)))));
        let keep = || {
            let path = folder("mutations").join(format!("{case}-{name}"));
            std::fs::write(&path, &bytes).unwrap();
            path
        };
        let Ok(result) = result else {
            panic!("case {case} of {name} panicked; it is kept in {:?}", keep());
        };
        let took = started.elapsed();
        assert!(took < TIME_MAX, "case {case} of {name} took {took:?}: {:?}", keep());
        assert!(peak < MEMORY_MAX, "case {case} of {name} took {peak} bytes: {:?}", keep());
        match result {
            Ok(loaded) => {
                loaded.file.splats.validate().unwrap();
                assert!(loaded.file.origin.iter().all(|c| c.is_finite()), "{:?}", keep());
                read += 1;
            }
            Err(error) => {
                let error = error.to_string();
                assert!(error.starts_with(name), "{error}");
                assert!(!error.contains('\n'), "{error}");
                refused += 1;
            }
        }
        if case == 0 {
            assert_eq!(read, 1, "the unchanged {name} is refused");
        }
    }
    println!("{name}: {read} read, {refused} refused");
    assert!(refused > 0, "no change to {name} was found out");
}

#[test]
fn files_that_are_not_zipped() {
    let folder = folder("mutate");
    let files =
        [("ply", 4, 1), ("compressed.ply", 4, 1), ("splat", 4, 0), ("glb", 2, 1), ("gltf", 2, 1)];
    for (ending, splats, degree) in files {
        let bytes = bytes_of(&folder, ending, &scene(splats, degree));
        run(&format!("mutated.{ending}"), &bytes, identity);
    }
}

#[test]
fn ksplat_of_all_levels() {
    for level in 0..3 {
        let name = format!("mutated{level}.ksplat");
        run(&name, &ksplat(&scene(5, 2), level), identity);
        // The headers are mostly empty: change the used parts more often.
        let whole = ksplat(&scene(5, 2), level);
        run(&name, &whole[4096..4096 + 48], |section| {
            let mut bytes = whole.clone();
            let length = section.len().min(1024);
            bytes[4096..4096 + length].copy_from_slice(&section[..length]);
            bytes
        });
    }
}

#[test]
fn spz() {
    let folder = folder("mutate-spz");
    let three = bytes_of(&folder, "spz", &scene(4, 1));
    run("mutated.spz", &three, identity);
    let mut payload = Vec::new();
    GzDecoder::new(three.as_slice()).read_to_end(&mut payload).unwrap();
    run("payload.spz", &payload, |bytes| gzip(&bytes));
    run("two.spz", &spz_2(&scene(4, 1).splats), |bytes| gzip(&bytes));
    run("four.spz", &spz_4(&scene(4, 1).splats), identity);
}

#[test]
fn sog() {
    let whole = bytes_of(&folder("mutate-sog"), "sog", &scene(4, 1));
    run("mutated.sog", &whole, identity);
    let entries = sog_entries(&whole);
    for (name, bytes) in &entries {
        let changed = name.replace("webp", "sog").replace("json", "sog");
        run(&changed, bytes, |bytes| {
            let mut entries = entries.clone();
            entries.iter_mut().find(|(other, _)| other == name).unwrap().1 = bytes;
            sog_of(&entries)
        });
    }
}
