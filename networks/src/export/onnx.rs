//! Writes a policy as ONNX.
//!
//! The networks are not described a second time: libtorch traces them, as for TorchScript, and each operator of the trace is
//! written as operators of ONNX. An operator that [`operators`] does not know is an error.

mod call;
mod graph;
mod operators;
mod proto;

use prost::Message as _;
use tch::TchError;

use super::file::{Exported, KEY};
use super::spec::{IMAGE, Vector};
use crate::error::Error;
use graph::{Argument, Graph, Value};
use operators::Writer;
use proto::Kind;

/// Version of ONNX's set of operators: the first with layer normalisation.
const OPERATORS: i64 = 17;
/// Version of ONNX's file format, that of the release with these operators.
const FORMAT: i64 = 8;

impl Exported {
    /// The policy of one task as an ONNX model. Its inputs and outputs are those of the [`Spec`](super::spec::Spec), by name, in
    /// their order, `[N, size]` each, for any number N of environments; those without entries are left out. An output with
    /// the name of an input has `next_` before it. The model's metadata has the description under the key [`KEY`].
    ///
    /// # Errors
    /// [`Error::Script`] if the part is not a policy of one task; [`Error::Onnx`] if it has an operator that cannot be written;
    /// [`Error::Torch`]; [`Error::File`], if the temporary directory cannot be written.
    pub fn to_onnx(&self) -> Result<Vec<u8>, Error> {
        let (module, examples) = self.trace()?;
        let file = tempfile::Builder::new().prefix("policy").suffix(".pt").tempfile().map_err(Error::File)?;
        module.save(file.path())?;
        let unread = |error: TchError| Error::Onnx { problem: format!("its trace cannot be read: {error}") };
        let graph = Graph::read(file.path(), &examples).map_err(unread)?;
        let mut writer = Writer::default();
        let mut inputs = Vec::new();
        for (vector, value) in self.spec.inputs.iter().zip(&graph.inputs).filter(|(vector, _)| vector.size > 0) {
            let kind = if vector.name == IMAGE { Kind::Uint8 } else { Kind::Float };
            writer.input(value, &vector.name);
            inputs.push(proto::Value::rows(&vector.name, kind, vector.size, &vector.meaning));
        }
        writer.nodes(&graph)?;
        let outputs: Vec<&Vector> = self.spec.outputs.iter().filter(|vector| vector.size > 0).collect();
        let is_input = |name: &str| self.spec.inputs.iter().any(|input| input.name == name);
        // In ONNX, a name occurs only once.
        let name = |name: &str| if is_input(name) { format!("next_{name}") } else { name.to_string() };
        let parts: Vec<(String, usize)> = outputs.iter().map(|vector| (name(&vector.name), vector.size)).collect();
        writer.outputs(joined(&graph, &parts)?, &parts)?;
        let outputs = outputs
            .iter()
            .map(|output| proto::Value::rows(&name(&output.name), Kind::Float, output.size, &output.meaning));
        let (nodes, initializers) = writer.finish();
        let description = serde_json::to_string(&self.spec).map_err(|error| Error::File(error.into()))?;
        let model = proto::Model {
            ir_version: FORMAT,
            opset_import: vec![proto::OperatorSet { domain: String::new(), version: OPERATORS }],
            producer_name: env!("CARGO_PKG_NAME").into(),
            producer_version: env!("CARGO_PKG_VERSION").into(),
            graph: Some(proto::Graph {
                nodes,
                name: self.spec.part.to_string(),
                initializers,
                inputs,
                outputs: outputs.collect(),
            }),
            metadata: vec![proto::Metadata { key: KEY.into(), value: description }],
        };
        Ok(model.encode_to_vec())
    }
}

/// The output of the trace, `[N, size]`, in which all outputs are joined.
fn joined<'a>(graph: &'a Graph, parts: &[(String, usize)]) -> Result<&'a Value, Error> {
    let size: usize = parts.iter().map(|(_, size)| size).sum();
    match &graph.outputs[..] {
        [Argument::Value(value)] if value.sizes == [None, Some(size as i64)] => Ok(value),
        other => Err(Error::Onnx { problem: format!("the trace has no output [N, {size}]: {other:?}") }),
    }
}

#[cfg(test)]
mod tests {
    use tch::{CModule, Kind, Tensor};

    use super::*;

    /// What is wrong with a trace of this function of `[N, 4]`.
    fn refused(forward: fn(&Tensor) -> Tensor) -> String {
        let example = [Tensor::zeros([1, 4], (Kind::Float, tch::Device::Cpu))];
        let mut traced = |inputs: &[Tensor]| vec![forward(&inputs[0])];
        let module = CModule::create_by_tracing("Function", "forward", &example, &mut traced).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("function.pt");
        module.save(&path).unwrap();
        let written = Graph::read(&path, &example).map_err(Error::from).and_then(|graph| {
            let mut writer = Writer::default();
            writer.input(&graph.inputs[0], "input");
            writer.nodes(&graph)
        });
        written.unwrap_err().to_string()
    }

    #[test]
    fn an_operator_that_is_not_known_is_refused_with_its_name() {
        let said = refused(|input| input.tanh().cos());
        assert!(said.contains("`aten::cos` is not known here") && said.contains(".pt"), "{said}");
    }

    #[test]
    fn an_argument_that_onnx_does_not_have_is_refused_with_its_name() {
        let said = refused(|input| input.square().sum_dim_intlist(-1_i64, false, Kind::Double));
        assert!(said.contains("`aten::sum.dim_IntList`: `dtype`"), "{said}");
    }

    #[test]
    fn a_number_type_that_is_not_known_is_refused() {
        let said = refused(|input| input.to_kind(Kind::Double));
        assert!(said.contains("type number 7"), "{said}");
    }

    #[test]
    fn a_change_of_a_part_of_a_tensor_is_refused() {
        let said = refused(|input| {
            let output = input.tanh();
            let _ = output.narrow(1, 0, 2).zero_();
            output
        });
        assert!(said.contains("`aten::zero_` is not known here"), "{said}");
    }

    #[test]
    fn a_trace_that_contains_the_number_of_rows_is_refused() {
        let said = refused(|input| input.reshape([1, 2, 2]));
        assert!(said.contains("shape '[1, 2, 2]' is invalid"), "{said}");
    }
}
