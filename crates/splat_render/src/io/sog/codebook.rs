//! The 256 numbers that stand for many: least squares in one dimension, by Lloyd's iteration.

use super::CODES;

/// Rounds of Lloyd's iteration; from quantiles, a dozen suffice.
const ROUNDS: usize = 12;

/// The codebook for `values`, ascending. Values that are few get a code each.
pub fn codebook(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let mut sorted: Vec<f32> = values.collect();
    sorted.sort_by(f32::total_cmp);
    let mut distinct = sorted.clone();
    distinct.dedup();
    let mut codes: Vec<f32> = if distinct.len() <= CODES {
        distinct
    } else {
        // Half at quantiles, which follow the density, half evenly, which bound the error of rare values.
        let half = CODES / 2;
        let (low, high) = (distinct[0], distinct[distinct.len() - 1]);
        let quantiles = (0..half).map(|k| sorted[(2 * k + 1) * sorted.len() / CODES]);
        let even = (0..half).map(|k| low + (high - low) * k as f32 / (half - 1) as f32);
        quantiles.chain(even).collect()
    };
    codes.sort_by(f32::total_cmp);
    if codes.len() == CODES {
        let mut sums = Vec::with_capacity(sorted.len() + 1);
        sums.push(0.0f64);
        for (i, value) in sorted.iter().enumerate() {
            sums.push(sums[i] + f64::from(*value));
        }
        for _ in 0..ROUNDS {
            let mut start = 0;
            for k in 0..CODES {
                let end = match codes.get(k + 1) {
                    Some(next) => {
                        let middle = (f64::from(codes[k]) + f64::from(*next)) / 2.0;
                        sorted.partition_point(|&v| f64::from(v) < middle)
                    }
                    None => sorted.len(),
                };
                // The old middle of this code was used by the last one; `end` never goes back.
                let end = end.max(start);
                if end > start {
                    codes[k] = ((sums[end] - sums[start]) / (end - start) as f64) as f32;
                }
                start = end;
            }
        }
    }
    // Codes that are not needed repeat the last, so that the list stays ascending.
    let last = codes.last().copied().unwrap_or(0.0);
    codes.resize(CODES, last);
    codes
}

/// The code whose number is nearest to `value`.
pub fn nearest(codebook: &[f32], value: f32) -> u8 {
    let above = codebook.partition_point(|&code| code < value).min(codebook.len() - 1);
    let below = above.saturating_sub(1);
    let far = |k: usize| (f64::from(codebook[k]) - f64::from(value)).abs();
    (if far(below) <= far(above) { below } else { above }) as u8
}
