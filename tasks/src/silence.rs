//! MuJoCo's own messages. Simulations often diverge in training. The environment reports and counts each divergence, so
//! MuJoCo's warnings would only fill a log file in the working directory.

use std::sync::Once;

use mujoco_rs::prelude::{MjLogMessage, MjtLogLevel, set_log_handler};

static INSTALLED: Once = Once::new();

/// Drops MuJoCo's warnings and prints its errors. Only the first call in a process has an effect.
#[allow(unsafe_code)]
pub(crate) fn install() {
    // SAFETY: the handler must not change while another thread runs MuJoCo. Every use of MuJoCo in this crate needs a
    // model, and every model is built after this call has returned.
    INSTALLED.call_once(|| unsafe { set_log_handler(handle) });
}

fn handle(message: &MjLogMessage) {
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        eprintln!("mujoco: {}", message.subject());
    }
}
