use std::sync::OnceLock;

use web_time::Instant;

/// Milliseconds since the first call. The only clock of a benchmark.
pub(super) fn now_ms() -> f64 {
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_secs_f64() * 1e3
}
