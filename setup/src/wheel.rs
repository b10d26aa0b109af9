//! What set-up knows of a wheel.

use std::path::PathBuf;

/// A wheel, pinned by version and hash.
pub(crate) struct Wheel {
    /// Its name on the package index.
    pub(crate) name: &'static str,
    /// Its version.
    pub(crate) version: &'static str,
    /// SHA-256 of the file, hexadecimal.
    pub(crate) sha256: &'static str,
    /// Size of the file in bytes.
    pub(crate) size: u64,
    /// Whether it holds machine code, which needs its own platform.
    pub(crate) native: bool,
    /// The part of set-up that it belongs to.
    pub(crate) part: Part,
    /// The smallest extent that needs it.
    pub(crate) from: Extent,
    /// The path in `.deps` of a file of the wheel; `None` leaves the file out.
    pub(crate) place: fn(&str, Extent) -> Option<PathBuf>,
    /// Links that are made beside the files: (link in `.deps`, the name that it points to).
    pub(crate) links: &'static [(&'static str, &'static str)],
}

/// How much is set up. Each extent includes the ones before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Extent {
    /// What a CPU needs.
    Cpu,
    /// All of libtorch, and NVIDIA's libraries.
    Cuda,
    /// torch_xla as well. It needs the libtorch that Python imports, which is the one with CUDA.
    Xla,
}

/// What wheels provide. A part that the user provides is not fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// libmujoco.
    Mujoco,
    /// libtorch and what it needs to run.
    Libtorch,
    /// The humanoid's XML and dm_control's test clips.
    DmControl,
    /// torch_xla and what it imports.
    Python,
}
