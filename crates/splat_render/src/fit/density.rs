//! How many splats there are to be.

/// Number of splats after a run of MCMC's control on `n`: a constant growth factor that reaches
/// `max_splats` in `runs_left` runs. The paper's 5 % per run is too little for few initial points.
pub(super) fn mcmc_target(n: usize, max_splats: usize, runs_left: u32) -> usize {
    let needed = (max_splats as f64 / n as f64).max(1.0);
    match runs_left {
        0 => n,
        left => {
            let grown = (n as f64 * needed.powf(1.0 / f64::from(left))).ceil() as usize;
            max_splats.min(grown).max(n)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mcmc_reaches_the_cap_from_few_splats() {
        let mut n = 100;
        let mut counts = Vec::new();
        for left in (0..8).rev() {
            n = mcmc_target(n, 20_000, left);
            counts.push(n);
        }
        assert_eq!(counts[6..], [20_000, 20_000]);
        let rates = counts[..7].windows(2).map(|pair| pair[1] as f64 / pair[0] as f64);
        assert!(rates.clone().all(|rate| (rate - 200f64.powf(1.0 / 7.0)).abs() < 0.02));
        assert_eq!(mcmc_target(50, 40, 3), 50);
    }
}
