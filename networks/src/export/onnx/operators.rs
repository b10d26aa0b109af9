//! The operators of libtorch in terms of those of ONNX.

use std::collections::BTreeMap;

use super::call::{Call, is_empty, kind};
use super::graph::{Argument, Graph, Value};
use super::proto::{self, Attribute, Kind};
use crate::error::Error;

/// The nodes of a model, in the order in which they are computed.
#[derive(Debug, Default)]
pub(super) struct Writer {
    nodes: Vec<proto::Node>,
    initializers: Vec<proto::Tensor>,
    /// The names of the values of the trace, by their numbers there.
    names: BTreeMap<usize, String>,
}

impl Writer {
    /// Names an input.
    pub(super) fn input(&mut self, value: &Value, name: &str) {
        self.names.insert(value.id, name.to_string());
    }

    /// Writes the nodes of a trace.
    ///
    /// # Errors
    /// [`Error::Onnx`], if an operator or one of its arguments cannot be written.
    pub(super) fn nodes(&mut self, graph: &Graph) -> Result<(), Error> {
        // Nothing reads a tensor without entries.
        for node in graph.nodes.iter().filter(|node| !node.outputs.iter().all(is_empty)) {
            let names = self.node(&Call { node, constants: &graph.constants })?;
            self.names.extend(node.outputs.iter().map(|output| output.id).zip(names));
        }
        Ok(())
    }

    /// Splits a value `[N, sizes]` into outputs with these names and sizes.
    ///
    /// # Errors
    /// [`Error::Onnx`], if no node makes the value.
    pub(super) fn outputs(&mut self, joined: &Value, parts: &[(String, usize)]) -> Result<(), Error> {
        let name = self.names.get(&joined.id).cloned();
        let name = name.ok_or_else(|| Error::Onnx { problem: "no operator makes the output".into() })?;
        let sizes: Vec<i64> = parts.iter().map(|(_, size)| *size as i64).collect();
        let inputs = vec![name, self.integers(&sizes)];
        let outputs = parts.iter().map(|(name, _)| name.clone()).collect();
        self.nodes.push(node("Split", inputs, outputs, [Attribute::of_integer("axis", 1)]));
        Ok(())
    }

    /// The nodes, and the constants that they read.
    pub(super) fn finish(self) -> (Vec<proto::Node>, Vec<proto::Tensor>) {
        (self.nodes, self.initializers)
    }

    /// Writes one operator of libtorch. Returns the names of its outputs.
    fn node(&mut self, call: &Call<'_>) -> Result<Vec<String>, Error> {
        let written = match call.node.operator.as_str() {
            "aten::add.Tensor" | "aten::add.Scalar" => self.arithmetic("Add", call)?,
            "aten::sub.Tensor" | "aten::sub.Scalar" => self.arithmetic("Sub", call)?,
            "aten::mul.Tensor" | "aten::mul.Scalar" => self.arithmetic("Mul", call)?,
            "aten::div.Tensor" | "aten::div.Scalar" => self.arithmetic("Div", call)?,
            "aten::addcmul" => {
                call.require("value", 1.0)?;
                let factors = [self.float(call, "tensor1")?, self.float(call, "tensor2")?];
                let product = self.put("Mul", factors, []);
                let term = self.float(call, "self")?;
                self.put("Add", [term, product], [])
            }
            "aten::square" => {
                let operand = self.float(call, "self")?;
                self.put("Mul", [operand.clone(), operand], [])
            }
            "aten::reciprocal" => self.function("Reciprocal", call, [])?,
            "aten::tanh" => self.function("Tanh", call, [])?,
            "aten::sigmoid" => self.function("Sigmoid", call, [])?,
            "aten::relu" => self.function("Relu", call, [])?,
            "aten::elu" => {
                call.require("scale", 1.0)?;
                call.require("input_scale", 1.0)?;
                self.function("Elu", call, [Attribute::of_number("alpha", call.number("alpha")?)])?
            }
            "aten::softplus" => {
                // Above `threshold` libtorch computes softplus(x) as x, which differs by less than e^−threshold.
                call.require("beta", 1.0)?;
                call.require("threshold", 20.0)?;
                self.function("Softplus", call, [])?
            }
            "aten::clamp" => {
                let operand = self.float(call, "self")?;
                let [least, greatest] = ["min", "max"].map(|bound| call.number(bound));
                let bounds = [self.number(least?), self.number(greatest?)];
                self.put("Clip", [operand].into_iter().chain(bounds), [])
            }
            "aten::log_softmax.int" => {
                call.require_none("dtype")?;
                self.function("LogSoftmax", call, [Attribute::of_integer("axis", call.integer("dim")?)])?
            }
            "aten::argmax" => {
                let keep = i64::from(call.truth("keepdim")?);
                let axis = Attribute::of_integer("axis", call.integer("dim")?);
                self.function("ArgMax", call, [axis, Attribute::of_integer("keepdims", keep)])?
            }
            "aten::sum.dim_IntList" => {
                call.require_none("dtype")?;
                let inputs = [self.float(call, "self")?, self.integers(&call.integers("dim")?)];
                self.put("ReduceSum", inputs, [Attribute::of_integer("keepdims", call.truth("keepdim")?.into())])
            }
            "aten::zeros_like" => {
                call.require_none("dtype")?;
                let like = self.float(call, "self")?;
                let shape = self.put("Shape", [like], []);
                let zero = self.number(0.0);
                self.put("Expand", [zero, shape], [])
            }
            "aten::linear" => self.linear(call)?,
            "aten::addmm" => {
                let inputs = [self.float(call, "mat1")?, self.float(call, "mat2")?, self.float(call, "self")?];
                let factors = ["alpha", "beta"].map(|name| Ok(Attribute::of_number(name, call.number(name)?)));
                let factors = factors.into_iter().collect::<Result<Vec<_>, Error>>()?;
                self.put("Gemm", inputs, factors)
            }
            "aten::baddbmm" => {
                call.require("alpha", 1.0)?;
                call.require("beta", 1.0)?;
                let factors = [self.float(call, "batch1")?, self.float(call, "batch2")?];
                let product = self.put("MatMul", factors, []);
                let term = self.float(call, "self")?;
                self.put("Add", [product, term], [])
            }
            "aten::layer_norm" => {
                let inputs = [self.float(call, "input")?, self.float(call, "weight")?, self.float(call, "bias")?];
                let axis = -(call.integers("normalized_shape")?.len() as i64);
                let epsilon = Attribute::of_number("epsilon", call.number("eps")?);
                self.put("LayerNormalization", inputs, [Attribute::of_integer("axis", axis), epsilon])
            }
            "aten::_convolution" => self.convolution(call)?,
            "aten::max_pool2d" => {
                // Rounding up is another rule there.
                if call.truth("ceil_mode")? {
                    return Err(call.unexpected("ceil_mode"));
                }
                let attributes = [
                    Attribute::of_integers("kernel_shape", call.pair("kernel_size")?),
                    Attribute::of_integers("strides", call.pair("stride")?),
                    Attribute::of_integers("pads", call.pair("padding")?.repeat(2)),
                    Attribute::of_integers("dilations", call.pair("dilation")?),
                ];
                self.function("MaxPool", call, attributes)?
            }
            "aten::to.dtype_layout" => {
                let operand = self.tensor(call, "self")?;
                self.put("Cast", [operand], [Attribute::of_integer("to", kind(call.output()?.kind)? as i64)])
            }
            "aten::reshape"
            | "aten::flatten.using_ints"
            | "aten::unflatten.int"
            | "aten::unsqueeze"
            | "aten::squeeze.dim" => self.reshape(call)?,
            "aten::transpose.int" => {
                let rank = call.output()?.sizes.len();
                let mut order: Vec<i64> = (0..rank as i64).collect();
                let [first, second] = ["dim0", "dim1"].map(|name| call.axis(name, rank));
                order.swap(first?, second?);
                self.rearrange(call, order)?
            }
            "aten::permute" => self.rearrange(call, call.integers("dims")?)?,
            "aten::expand" => {
                // An axis that keeps its size is −1 in libtorch and 1 in ONNX.
                let sizes: Vec<i64> = call.integers("size")?.into_iter().map(|size| size.max(1)).collect();
                let inputs = [self.tensor(call, "self")?, self.integers(&sizes)];
                self.put("Expand", inputs, [])
            }
            "aten::gather" => {
                let inputs = [self.tensor(call, "self")?, self.tensor(call, "index")?];
                self.put("GatherElements", inputs, [Attribute::of_integer("axis", call.integer("dim")?)])
            }
            "aten::narrow" => {
                let (start, length) = (call.integer("start")?, call.integer("length")?);
                if start < 0 {
                    return Err(call.unexpected("start"));
                }
                let operand = self.tensor(call, "self")?;
                let bounds = [start, start + length, call.integer("dim")?].map(|number| self.integers(&[number]));
                self.put("Slice", [operand].into_iter().chain(bounds), [])
            }
            "aten::cat" => {
                let tensors = self.tensors(call, "tensors")?;
                self.put("Concat", tensors, [Attribute::of_integer("axis", call.integer("dim")?)])
            }
            "aten::stack" => {
                let axis = call.integer("dim")?;
                let mut slices = Vec::new();
                for tensor in self.tensors(call, "tensors")? {
                    let axes = self.integers(&[axis]);
                    slices.push(self.put("Unsqueeze", [tensor, axes], []));
                }
                self.put("Concat", slices, [Attribute::of_integer("axis", axis)])
            }
            "aten::split.Tensor" => return self.split(call),
            "aten::unbind.int" => return self.unbind(call),
            other => {
                return Err(Error::Onnx { problem: format!("libtorch's operator `{other}` is not known here") });
            }
        };
        Ok(vec![written])
    }

    /// An operator with two operands, of which the second may be a number.
    fn arithmetic(&mut self, operator: &str, call: &Call<'_>) -> Result<String, Error> {
        if call.node.arguments.contains_key("alpha") {
            call.require("alpha", 1.0)?;
        }
        let first = self.float(call, "self")?;
        let second = match call.argument("other")? {
            Argument::Integer(_) | Argument::Number(_) => self.number(call.number("other")?),
            _ => self.float(call, "other")?,
        };
        Ok(self.put(operator, [first, second], []))
    }

    /// An operator with one operand, `self`.
    fn function(
        &mut self,
        operator: &str,
        call: &Call<'_>,
        attributes: impl IntoIterator<Item = Attribute>,
    ) -> Result<String, Error> {
        let operand = self.float(call, "self")?;
        Ok(self.put(operator, [operand], attributes))
    }

    /// x · Wᵀ + b.
    fn linear(&mut self, call: &Call<'_>) -> Result<String, Error> {
        let [input, weight, bias] = ["input", "weight", "bias"].map(|name| self.float(call, name));
        let (input, weight, bias) = (input?, weight?, bias?);
        if call.output()?.sizes.len() == 2 {
            return Ok(self.put("Gemm", [input, weight, bias], [Attribute::of_integer("transB", 1)]));
        }
        // Gemm has matrices only.
        let transposed = self.put("Transpose", [weight], []);
        let product = self.put("MatMul", [input, transposed], []);
        Ok(self.put("Add", [product, bias], []))
    }

    fn convolution(&mut self, call: &Call<'_>) -> Result<String, Error> {
        if call.truth("transposed")? {
            return Err(call.wrong("a transposed convolution is not known".into()));
        }
        let inputs = [self.float(call, "input")?, self.float(call, "weight")?, self.float(call, "bias")?];
        let attributes = [
            Attribute::of_integers("strides", call.pair("stride")?),
            Attribute::of_integers("pads", call.pair("padding")?.repeat(2)),
            Attribute::of_integers("dilations", call.pair("dilation")?),
            Attribute::of_integer("group", call.integer("groups")?),
        ];
        Ok(self.put("Conv", inputs, attributes))
    }

    /// The same numbers with the sizes that libtorch found for the output. The size that depends on N is −1.
    fn reshape(&mut self, call: &Call<'_>) -> Result<String, Error> {
        let sizes = &call.output()?.sizes;
        if sizes.iter().filter(|size| size.is_none()).count() > 1 {
            return Err(call.wrong("more than one size depends on N".into()));
        }
        let sizes: Vec<i64> = sizes.iter().map(|size| size.unwrap_or(-1)).collect();
        let inputs = [self.tensor(call, "self")?, self.integers(&sizes)];
        Ok(self.put("Reshape", inputs, []))
    }

    fn rearrange(&mut self, call: &Call<'_>, order: Vec<i64>) -> Result<String, Error> {
        let rank = order.len() as i64;
        let order: Vec<i64> = order.into_iter().map(|axis| if axis < 0 { axis + rank } else { axis }).collect();
        let operand = self.tensor(call, "self")?;
        Ok(self.put("Transpose", [operand], [Attribute::of_integers("perm", order)]))
    }

    fn split(&mut self, call: &Call<'_>) -> Result<Vec<String>, Error> {
        let axis = call.axis("dim", call.output()?.sizes.len())?;
        let sizes: Option<Vec<i64>> = call.node.outputs.iter().map(|output| output.sizes.get(axis).copied()?).collect();
        let sizes = sizes.ok_or_else(|| call.wrong("the size of a part depends on N".into()))?;
        let inputs = vec![self.tensor(call, "self")?, self.integers(&sizes)];
        let names: Vec<String> = (0..sizes.len()).map(|part| format!("split_{}_{part}", self.nodes.len())).collect();
        self.nodes.push(node("Split", inputs, names.clone(), [Attribute::of_integer("axis", axis as i64)]));
        Ok(names)
    }

    fn unbind(&mut self, call: &Call<'_>) -> Result<Vec<String>, Error> {
        let axis = call.integer("dim")?;
        let operand = self.tensor(call, "self")?;
        let parts = (0..call.node.outputs.len() as i64).map(|part| {
            let index = self.constant(Kind::Int64, Vec::new(), part.to_le_bytes().into());
            self.put("Gather", [operand.clone(), index], [Attribute::of_integer("axis", axis)])
        });
        Ok(parts.collect())
    }

    /// Adds a node with one output. Returns the output's name.
    fn put(
        &mut self,
        operator: &str,
        inputs: impl IntoIterator<Item = String>,
        attributes: impl IntoIterator<Item = Attribute>,
    ) -> String {
        let name = format!("{}_{}", operator.to_lowercase(), self.nodes.len());
        self.nodes.push(node(operator, inputs.into_iter().collect(), vec![name.clone()], attributes));
        name
    }

    /// The name of a constant, which is written once.
    fn constant(&mut self, kind: Kind, sizes: Vec<i64>, data: Vec<u8>) -> String {
        let kind = kind as i32;
        let same = |known: &&proto::Tensor| known.kind == kind && known.sizes == sizes && known.data == data;
        if let Some(known) = self.initializers.iter().find(same) {
            return known.name.clone();
        }
        let name = format!("constant_{}", self.initializers.len());
        self.initializers.push(proto::Tensor { sizes, kind, name: name.clone(), data });
        name
    }

    fn number(&mut self, number: f64) -> String {
        self.constant(Kind::Float, Vec::new(), (number as f32).to_le_bytes().into())
    }

    fn integers(&mut self, integers: &[i64]) -> String {
        let data = integers.iter().flat_map(|integer| integer.to_le_bytes()).collect();
        self.constant(Kind::Int64, vec![integers.len() as i64], data)
    }

    /// The name of a tensor in single precision.
    fn float(&mut self, call: &Call<'_>, name: &str) -> Result<String, Error> {
        if let Argument::Value(value) = call.argument(name)?
            && kind(value.kind)? != Kind::Float
        {
            return Err(call.wrong(format!("`{name}` is not in single precision")));
        }
        self.tensor(call, name)
    }

    /// The name of a tensor.
    fn tensor(&mut self, call: &Call<'_>, name: &str) -> Result<String, Error> {
        self.named(call, call.argument(name)?)
    }

    /// The names of the tensors in a list that have entries.
    fn tensors(&mut self, call: &Call<'_>, name: &str) -> Result<Vec<String>, Error> {
        let Argument::List(list) = call.argument(name)? else { return Err(call.unexpected(name)) };
        let full = list.iter().filter(|each| !matches!(each, Argument::Value(value) if is_empty(value)));
        full.map(|each| self.named(call, each)).collect()
    }

    fn named(&mut self, call: &Call<'_>, argument: &Argument) -> Result<String, Error> {
        match argument {
            Argument::Value(value) => {
                let known = self.names.get(&value.id).cloned();
                known.ok_or_else(|| call.wrong("it reads a tensor that no operator makes".into()))
            }
            Argument::Constant { constant } => {
                let tensor = call.constants.get(*constant);
                let tensor = tensor.ok_or_else(|| call.wrong("it reads a constant that is missing".into()))?;
                if tensor.kind() != tch::Kind::Float {
                    return Err(call.wrong(format!("it reads a constant of {:?}", tensor.kind())));
                }
                let numbers: Vec<f32> = tensor.flatten(0, -1).try_into()?;
                let data = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
                Ok(self.constant(Kind::Float, tensor.size(), data))
            }
            other => Err(call.wrong(format!("{other:?} is not a tensor"))),
        }
    }
}

fn node(
    operator: &str,
    inputs: Vec<String>,
    outputs: Vec<String>,
    attributes: impl IntoIterator<Item = Attribute>,
) -> proto::Node {
    proto::Node { inputs, outputs, operator: operator.into(), attributes: attributes.into_iter().collect() }
}
