//! The device of the learner, as experiments and command lines write it.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The device on which the update runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum DeviceName {
    /// `cpu`: the processors of the learner's machine.
    #[default]
    Cpu,
    /// `cuda` or `cuda:N`: an NVIDIA GPU, with CUDA's number.
    Cuda(usize),
    /// `xla` or `xla:N`: the kind of device that PJRT_DEVICE names, a TPU or a CPU.
    Xla(usize),
}

impl FromStr for DeviceName {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let (kind, index) = name.split_once(':').unwrap_or((name, "0"));
        match (kind, index.parse::<u8>()) {
            _ if name == "cpu" => Ok(Self::Cpu),
            ("cuda", Ok(index)) => Ok(Self::Cuda(index.into())),
            ("xla", Ok(index)) => Ok(Self::Xla(index.into())),
            _ => Err(format!("no device `{name}`; devices are cpu, cuda, cuda:N, xla and xla:N, N up to 255")),
        }
    }
}

impl TryFrom<String> for DeviceName {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        name.parse()
    }
}

impl fmt::Display for DeviceName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => formatter.write_str("cpu"),
            Self::Cuda(index) => write!(formatter, "cuda:{index}"),
            Self::Xla(index) => write!(formatter, "xla:{index}"),
        }
    }
}

impl From<DeviceName> for String {
    fn from(name: DeviceName) -> Self {
        name.to_string()
    }
}

/// How precisely XLA multiplies float32 matrices. A TPU multiplies bfloat16 numbers; several passes give a float32 result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MatmulPrecision {
    /// Six passes, about 22 bits. V-MPO's limit of 1e-5 on the covariance needs this precision.
    #[default]
    Highest,
    /// Three passes, about 14 bits.
    High,
    /// One pass, bfloat16.
    Default,
}

impl MatmulPrecision {
    /// As experiments and torch_xla write it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Highest => "highest",
            Self::High => "high",
            Self::Default => "default",
        }
    }
}

/// The numbers in which the learner publishes parameters. It computes with float32, and so do actors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PublishedNumber {
    /// As the learner has them.
    #[default]
    Float32,
    /// Rounded to 8 bits of precision, for half of the bytes. The normaliser stays float32.
    Bfloat16,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reading_inverts_writing_a_device() {
        for device in [DeviceName::Cpu, DeviceName::Cuda(0), DeviceName::Cuda(3), DeviceName::Xla(255)] {
            assert_eq!(device.to_string().parse(), Ok(device));
        }
        assert_eq!(("cuda".parse(), "xla".parse()), (Ok(DeviceName::Cuda(0)), Ok(DeviceName::Xla(0))));
    }

    #[test]
    fn an_unknown_device_is_refused_with_the_list_of_devices() {
        for name in ["", "gpu", "cpu:0", "cuda:", "cuda:-1", "xla:256", "CUDA", "xla:0:0", "tpu"] {
            let refused = name.parse::<DeviceName>().unwrap_err();
            assert!(refused.contains(&format!("`{name}`")) && refused.contains("cuda:N"), "{refused}");
        }
    }
}
