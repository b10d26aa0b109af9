//! The arguments of an operator, and what is wrong with them.

use tch::Tensor;

use super::graph::{Argument, Node, Value};
use super::proto::Kind;
use crate::error::Error;

/// One operator of libtorch with its arguments.
pub(super) struct Call<'a> {
    pub(super) node: &'a Node,
    /// The constants of the graph.
    pub(super) constants: &'a [Tensor],
}

impl Call<'_> {
    pub(super) fn wrong(&self, problem: String) -> Error {
        Error::Onnx { problem: format!("`{}`: {problem}", self.node.operator) }
    }

    pub(super) fn unexpected(&self, name: &str) -> Error {
        self.wrong(format!("`{name}` is {:?}", self.node.arguments.get(name)))
    }

    pub(super) fn argument(&self, name: &str) -> Result<&Argument, Error> {
        self.node.arguments.get(name).ok_or_else(|| self.unexpected(name))
    }

    /// Its first output.
    pub(super) fn output(&self) -> Result<&Value, Error> {
        self.node.outputs.first().ok_or_else(|| self.wrong("it has no output".into()))
    }

    pub(super) fn integer(&self, name: &str) -> Result<i64, Error> {
        match self.argument(name)? {
            Argument::Integer(integer) => Ok(*integer),
            _ => Err(self.unexpected(name)),
        }
    }

    pub(super) fn integers(&self, name: &str) -> Result<Vec<i64>, Error> {
        let Argument::List(list) = self.argument(name)? else { return Err(self.unexpected(name)) };
        let integers = list.iter().map(|each| match each {
            Argument::Integer(integer) => Ok(*integer),
            _ => Err(self.unexpected(name)),
        });
        integers.collect()
    }

    /// Two integers, for the two axes of an image. libtorch also takes one for both, or none for a default.
    pub(super) fn pair(&self, name: &str) -> Result<Vec<i64>, Error> {
        let integers = self.integers(name)?;
        if integers.len() == 2 { Ok(integers) } else { Err(self.unexpected(name)) }
    }

    pub(super) fn number(&self, name: &str) -> Result<f64, Error> {
        match self.argument(name)? {
            Argument::Integer(integer) => Ok(*integer as f64),
            Argument::Number(number) => Ok(*number),
            _ => Err(self.unexpected(name)),
        }
    }

    pub(super) fn truth(&self, name: &str) -> Result<bool, Error> {
        match self.argument(name)? {
            Argument::Bool(truth) => Ok(*truth),
            _ => Err(self.unexpected(name)),
        }
    }

    /// An axis of a tensor of this rank, counted from the first.
    pub(super) fn axis(&self, name: &str, rank: usize) -> Result<usize, Error> {
        let axis = self.integer(name)?;
        let axis = usize::try_from(if axis < 0 { axis + rank as i64 } else { axis }).ok();
        axis.filter(|axis| *axis < rank).ok_or_else(|| self.unexpected(name))
    }

    /// Refuses another value of an argument that ONNX does not have.
    pub(super) fn require(&self, name: &str, value: f64) -> Result<(), Error> {
        if self.number(name)? == value { Ok(()) } else { Err(self.unexpected(name)) }
    }

    pub(super) fn require_none(&self, name: &str) -> Result<(), Error> {
        if matches!(self.argument(name)?, Argument::None) { Ok(()) } else { Err(self.unexpected(name)) }
    }
}

/// Whether a tensor has no entries.
pub(super) fn is_empty(value: &Value) -> bool {
    value.sizes.contains(&Some(0))
}

/// ONNX's type for one of libtorch (c10/core/ScalarType.h).
pub(super) fn kind(kind: i8) -> Result<Kind, Error> {
    match kind {
        0 => Ok(Kind::Uint8),
        4 => Ok(Kind::Int64),
        6 => Ok(Kind::Float),
        other => Err(Error::Onnx { problem: format!("libtorch's type number {other} is not known") }),
    }
}
