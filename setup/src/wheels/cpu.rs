//! The wheels that every set-up needs, and what is taken from each.

use std::path::PathBuf;

use crate::wheel::{Extent, Part, Wheel};

/// Small wheels come first.
pub(super) const WHEELS: [Wheel; 5] = [
    Wheel {
        name: "mujoco",
        version: "3.17.0",
        sha256: "d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874",
        size: 26_482_984,
        native: true,
        part: Part::Mujoco,
        from: Extent::Cpu,
        place: mujoco,
        links: &[("mujoco/lib/libmujoco.so", "libmujoco.so.3.17.0")],
    },
    Wheel {
        name: "dm_control",
        version: "1.0.49",
        sha256: "eb43ee7bb72179a5c0a5af42d10979c0f660a1194436b770151ed231c8eb8dda",
        size: 56_452_238,
        native: false,
        part: Part::DmControl,
        from: Extent::Cpu,
        place: dm_control,
        links: &[],
    },
    Wheel {
        name: "nvidia-cuda-runtime-cu12",
        version: "12.8.90",
        sha256: "adade8dcbd0edf427b7204d480d6066d33902cab2a4707dcfc48a2d0fd44ab90",
        size: 954_765,
        native: true,
        part: Part::Libtorch,
        from: Extent::Cpu,
        place: |file, extent| nvidia(file, "nvidia/cuda_runtime/lib/libcudart.so.12", extent),
        links: &[],
    },
    Wheel {
        name: "nvidia-cuda-cupti-cu12",
        version: "12.8.90",
        sha256: "ea0cb07ebda26bb9b29ba82cda34849e73c166c18162d3913575b0c9db9a6182",
        size: 10_248_621,
        native: true,
        part: Part::Libtorch,
        from: Extent::Cpu,
        place: |file, extent| nvidia(file, "nvidia/cuda_cupti/lib/libcupti.so.12", extent),
        links: &[],
    },
    Wheel {
        name: "torch",
        version: "2.9.0",
        sha256: "51de31219c97c51cf4bf2be94d622e3deb5dcc526c6dc00e97c17eaec0fc1d67",
        size: 899_815_990,
        native: true,
        part: Part::Libtorch,
        from: Extent::Cpu,
        place: torch,
        links: &[],
    },
];

/// The place of a licence's text: `licences/WHEEL/FILE`. Who passes a library on passes its licence on, too.
fn licence(file: &str) -> Option<PathBuf> {
    let (wheel, inside) = file.split_once(".dist-info/")?;
    let name = inside.strip_prefix("licenses/").unwrap_or(inside);
    let texts = ["LICENSE", "LICENSES_THIRD_PARTY.md", "License.txt", "NOTICE"];
    texts.contains(&name).then(|| format!("licences/{}/{name}", wheel.split('-').next().unwrap_or(wheel)).into())
}

fn mujoco(file: &str, _extent: Extent) -> Option<PathBuf> {
    (file == "mujoco/libmujoco.so.3.17.0").then(|| "mujoco/lib/libmujoco.so.3.17.0".into()).or_else(|| licence(file))
}

fn dm_control(file: &str, _extent: Extent) -> Option<PathBuf> {
    let wanted = [
        "dm_control/composer/arena.xml",
        "dm_control/locomotion/walkers/assets/humanoid_CMU_V2019.xml",
        "dm_control/locomotion/walkers/assets/humanoid_CMU_V2020.xml",
        "dm_control/locomotion/mocap/test_trajectories.h5",
    ];
    let name = file.rsplit('/').next()?;
    wanted.contains(&file).then(|| format!("dm_control/{name}").into()).or_else(|| licence(file))
}

/// torch-sys links CUDA only where `libtorch_cuda.so` exists. These four libraries and the headers are a CPU libtorch.
const CPU_LIBRARIES: [&str; 4] = ["libc10.so", "libtorch.so", "libtorch_cpu.so", "libgomp.so.1"];

/// A CPU libtorch needs the one file `wanted`, in its own directory.
fn nvidia(file: &str, wanted: &str, extent: Extent) -> Option<PathBuf> {
    if extent > Extent::Cpu {
        return Some(format!("python/{file}").into());
    }
    let name = wanted.rsplit('/').next()?;
    (file == wanted).then(|| format!("libtorch/lib/{name}").into()).or_else(|| licence(file))
}

fn torch(file: &str, extent: Extent) -> Option<PathBuf> {
    // Python's torch imports both.
    if extent > Extent::Cpu && (file.starts_with("torchgen/") || file.starts_with("functorch/")) {
        return Some(format!("python/{file}").into());
    }
    let Some(inside) = file.strip_prefix("torch/") else { return licence(file) };
    let on_cpu =
        inside.starts_with("include/") || inside.strip_prefix("lib/").is_some_and(|name| CPU_LIBRARIES.contains(&name));
    (extent > Extent::Cpu || on_cpu).then(|| format!("libtorch/{inside}").into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cpu_libtorch_has_no_cuda_library_and_a_cuda_libtorch_has_every_file() {
        assert_eq!(torch("torch/lib/libtorch_cpu.so", Extent::Cpu), Some("libtorch/lib/libtorch_cpu.so".into()));
        assert_eq!(torch("torch/lib/libtorch_cuda.so", Extent::Cpu), None);
        assert_eq!(torch("torch/lib/libtorch_cuda.so", Extent::Cuda), Some("libtorch/lib/libtorch_cuda.so".into()));
        assert_eq!(torch("torch/include/ATen/ATen.h", Extent::Cpu), Some("libtorch/include/ATen/ATen.h".into()));
        assert_eq!(torch("functorch/dim.py", Extent::Cpu), None);
        assert_eq!(torch("torchgen/model.py", Extent::Xla), Some("python/torchgen/model.py".into()));
    }

    #[test]
    fn the_text_of_a_licence_is_kept_below_the_name_of_its_wheel() {
        let nvidia = |file| nvidia(file, "nvidia/cuda_runtime/lib/libcudart.so.12", Extent::Cpu);
        for (found, place) in [
            (mujoco("mujoco-3.17.0.dist-info/licenses/LICENSE", Extent::Cpu), "mujoco/LICENSE"),
            (dm_control("dm_control-1.0.49.dist-info/licenses/LICENSE", Extent::Cpu), "dm_control/LICENSE"),
            (torch("torch-2.9.0.dist-info/licenses/NOTICE", Extent::Cuda), "torch/NOTICE"),
            (nvidia("nvidia_cuda_runtime_cu12-12.8.90.dist-info/License.txt"), "nvidia_cuda_runtime_cu12/License.txt"),
        ] {
            assert_eq!(found, Some(PathBuf::from("licences").join(place)));
        }
        assert_eq!(torch("torch-2.9.0.dist-info/METADATA", Extent::Cpu), None);
    }

    #[test]
    fn only_the_composers_arena_is_taken_from_dm_control() {
        assert_eq!(dm_control("dm_control/composer/arena.xml", Extent::Cpu), Some("dm_control/arena.xml".into()));
        assert_eq!(dm_control("dm_control/mjcf/test_assets/arena.xml", Extent::Cpu), None);
    }
}
