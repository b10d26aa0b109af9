//! MuJoCo's own messages. A diverging simulation is an everyday event in training: the environment reports and
//! counts it, so MuJoCo's text about it would only fill a log file in the working directory.

use std::sync::Once;

use mujoco_rs::prelude::{MjLogMessage, MjtLogLevel, set_log_handler};

static INSTALLED: Once = Once::new();

/// Drops MuJoCo's warnings and keeps its errors, once per process.
#[allow(unsafe_code)]
pub(crate) fn install() {
    // SAFETY: the handler must not change while another thread is inside MuJoCo. Every use of MuJoCo in this crate
    // goes through a model, and every model is built after this call has returned in some thread.
    INSTALLED.call_once(|| unsafe { set_log_handler(handle) });
}

fn handle(message: &MjLogMessage) {
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        eprintln!("mujoco: {}", message.subject());
    }
}
