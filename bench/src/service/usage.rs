//! What a process has used, as Linux reports it.

use std::fs;

use serde::{Deserialize, Serialize};

/// The usage of the calling process.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Usage {
    /// User and system time of all threads.
    pub(super) cpu_seconds: f64,
    /// Resident memory, bytes.
    pub(super) resident: f64,
    /// The largest resident memory so far, bytes.
    pub(super) peak: f64,
}

impl Usage {
    pub(super) fn now() -> Self {
        let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
        // Only the program's name may contain spaces, and it ends at the last parenthesis. User and system time are the
        // 12th and 13th fields after it.
        let after_name = stat.rsplit_once(')').map_or("", |(_, rest)| rest);
        let ticks: f64 =
            after_name.split_whitespace().skip(11).take(2).filter_map(|field| field.parse::<f64>().ok()).sum();
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        let kilobytes = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_default();
            line.split_whitespace().next().and_then(|number| number.parse::<f64>().ok()).unwrap_or_default()
        };
        Self {
            cpu_seconds: ticks / rustix::param::clock_ticks_per_second() as f64,
            resident: kilobytes("VmRSS:") * 1024.0,
            peak: kilobytes("VmHWM:") * 1024.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_is_counted_as_time_and_memory() {
        let before = Usage::now();
        let memory = vec![1_u8; 64 << 20];
        let start = std::time::Instant::now();
        while start.elapsed().as_millis() < 50 {
            std::hint::black_box(memory.iter().map(|byte| u64::from(*byte)).sum::<u64>());
        }
        let after = Usage::now();
        assert!(after.cpu_seconds > before.cpu_seconds);
        assert!(after.peak >= 64e6 && after.resident > 0.0);
    }
}
