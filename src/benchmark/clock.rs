use std::sync::OnceLock;
use std::time::Instant;

/// Milliseconds since the first call. The only clock of a benchmark: a browser has another one.
pub(super) fn now_ms() -> f64 {
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_secs_f64() * 1e3
}
