//! The wheels for accelerators: NVIDIA's libraries, which a libtorch with CUDA links, and torch_xla with everything that it
//! imports. torch 2.9.0 and torch_xla 2.9.0 name these packages; these versions work together.

use crate::wheel::{Extent, Part, Wheel};

const fn wheel(name: &'static str, version: &'static str, sha256: &'static str, size: u64) -> Wheel {
    Wheel {
        name,
        version,
        sha256,
        size,
        native: true,
        part: Part::Python,
        from: Extent::Xla,
        place: |file, _| (!file.contains(".data/")).then(|| format!("python/{file}").into()),
        links: &[],
    }
}

const fn nvidia(name: &'static str, version: &'static str, sha256: &'static str, size: u64) -> Wheel {
    Wheel { part: Part::Libtorch, from: Extent::Cuda, ..wheel(name, version, sha256, size) }
}

/// Small wheels come first.
pub(super) const WHEELS: [Wheel; 31] = [
    nvidia("nvidia-nvtx-cu12", "12.8.90", "5b17e2001cc0d751a5bc2c6ec6d26ad95913324a4adb86788c944f8ce9ba441f", 89_954),
    nvidia(
        "nvidia-cufile-cu12",
        "1.13.1.3",
        "1d069003be650e131b21c932ec3d8969c1715379251f8d23a1860554b1cb24fc",
        1_197_834,
    ),
    nvidia(
        "nvidia-nvjitlink-cu12",
        "12.8.93",
        "81ff63371a7ebd6e6451970684f916be2eab07321b73c9d244dc2b4da7f73b88",
        39_254_836,
    ),
    nvidia(
        "nvidia-curand-cu12",
        "10.3.9.90",
        "b32331d4f4df5d6eefa0554c565b626c7216f87a06a4f56fab27c3b68a830ec9",
        63_619_976,
    ),
    nvidia(
        "nvidia-cuda-nvrtc-cu12",
        "12.8.93",
        "a7756528852ef889772a84c6cd89d41dfa74667e24cca16bb31f8f061e3e9994",
        88_040_029,
    ),
    nvidia(
        "nvidia-nvshmem-cu12",
        "3.3.20",
        "d00f26d3f9b2e3c3065be895e3059d6479ea5c638a3f38c9fec49b1b9dd7c1e5",
        124_657_145,
    ),
    nvidia(
        "nvidia-cufft-cu12",
        "11.3.3.83",
        "4d2dd21ec0b88cf61b62e6b43564355e5222e4a3fb394cac0db101f2dd0d4f74",
        193_118_695,
    ),
    nvidia(
        "nvidia-cusolver-cu12",
        "11.7.3.90",
        "4376c11ad263152bd50ea295c05370360776f8c3427b30991df774f9fb26c450",
        267_506_905,
    ),
    nvidia(
        "nvidia-cusparselt-cu12",
        "0.7.1",
        "f1bb701d6b930d5a7cea44c19ceb973311500847f81b634d802b7b539dc55623",
        287_193_691,
    ),
    nvidia(
        "nvidia-cusparse-cu12",
        "12.5.8.93",
        "1ec05d76bbbd8b61b06a80e1eaf8cf4959c3d4ce8e711b65ebd0443bb0ebb13b",
        288_216_466,
    ),
    nvidia(
        "nvidia-nccl-cu12",
        "2.27.5",
        "ad730cf15cb5d25fe849c6e6ca9eb5b76db16a80f13f425ac68d8e2e55624457",
        322_348_229,
    ),
    nvidia(
        "nvidia-cublas-cu12",
        "12.8.4.1",
        "8ac4e771d5a348c551b2a426eda6193c19aa630236b418086020df5ba9667142",
        594_346_921,
    ),
    nvidia(
        "nvidia-cudnn-cu12",
        "9.10.2.21",
        "949452be657fa16687d0930933f032835951ef0892b37d2d53824d1a84dc97a8",
        706_758_467,
    ),
    wheel("markupsafe", "3.0.4", "6da83a088f8ef93b2d483a8232a4dbf4d69d3d8496b568a03c56becac43e1808", 22_961),
    wheel("typing-extensions", "4.16.0", "481caa481374e813c1b176ada14e97f1f67a4539ce9cfeb3f350d78d6370c2e8", 45_571),
    wheel("idna", "3.20", "ab7ae7122974553370f0bdb919e1a960b2cd1bc1ef0276416d896db81c14582c", 69_583),
    wheel("requests", "2.34.2", "2a0d60c172f83ac6ab31e4554906c0f3b3588d37b5cb939b1c061f4907e278e0", 73_075),
    wheel("certifi", "2026.10.18", "73191c47aaa79da394e8fee2dbc2ec827432cab56311122c9e47abf79e390f62", 134_093),
    wheel("jinja2", "3.1.6", "85ece4451f492d0c13c5dd7c13a64681a86afae63a5f347908daf103ce6d2f67", 134_899),
    wheel("urllib3", "2.8.0", "0cf3cae568d36aa9576b28dfb35f11328f1cb974ca7647d9475ebb86c75ac6e3", 135_717),
    wheel("absl-py", "2.5.1", "721200f2f0e9960f2ca9dc3a2a706b201f5f75d812c158f059cbbe29eeafbdb8", 137_673),
    wheel("fsspec", "2026.9.0", "8dd6e646e99ea382bd85f97a45e6b526a442d79423a7dc673f1e2756d05fcb5f", 221_738),
    wheel("filelock", "4.2.11", "020e229e4bb9d410fc799c07ddf45fa217cba970278f40b30751d94f309b69e2", 222_003),
    wheel("charset-normalizer", "3.5.2", "211d5a3eb6af8f513b8d4ca19a8c1b7accab1b5f0d3175f9826b03c1a920dc1f", 269_972),
    wheel("mpmath", "1.4.1", "dc4f0ea2304480d4a9a48a94c1020571558ade522b44a6912efac63a586e140f", 567_787),
    wheel("pyyaml", "6.0.3", "b8bb0864c5a28024fac8a632c443c87c5aa6f215c0b126c449ae1a150412f31d", 806_638),
    wheel("networkx", "3.6.1", "d47fbf302e7d9cbbb9e2555a0d267983d2aa476bac30e90dfbe5669bd57f3762", 2_068_504),
    wheel("sympy", "1.14.0", "e091cc3e99d2141a0ba2847328f5479b05d94a6635cb96148ccb3f34671bd8f5", 6_299_353),
    wheel("numpy", "2.2.6", "ba10f8411898fc418a521833e014a77d3ca01c15b0c6cdcce6a0d2897e6dbbdf", 16_821_570),
    wheel("torch-xla", "2.9.0", "13027393e252c7583ac364b02af8f1c0f7c497095b653c14ead82fbbda8549c3", 80_304_037),
    wheel("libtpu", "0.0.21", "048305597c92ca31f805a62d402c101019b286250b939ef96c24e9d110cdf80a", 149_753_699),
];
