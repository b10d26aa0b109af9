//! The operators of a TorchScript module: see `graph.cpp`.

#![allow(unsafe_code, reason = "calls C++ functions")]

use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_void};
use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;

use serde::Deserialize;
use tch::{TchError, Tensor};

unsafe extern "C" {
    fn comic_graph_read(
        path: *const c_char,
        inputs: *const *const c_void,
        count: usize,
        message: *mut c_char,
        room: usize,
    ) -> *mut c_void;
    fn comic_graph_json(graph: *const c_void, length: *mut usize) -> *const u8;
    fn comic_graph_constants(graph: *const c_void) -> usize;
    fn comic_graph_constant(graph: *const c_void, index: usize) -> *mut c_void;
    fn comic_graph_free(graph: *mut c_void);
}

/// What a module computes: nodes in an order in which each reads only what is before it.
#[derive(Debug, Deserialize)]
pub(super) struct Graph {
    pub(super) inputs: Vec<Value>,
    pub(super) nodes: Vec<Node>,
    pub(super) outputs: Vec<Argument>,
    /// Weights, and what libtorch computed of them.
    #[serde(skip)]
    pub(super) constants: Vec<Tensor>,
}

/// One operator.
#[derive(Debug, Deserialize)]
pub(super) struct Node {
    /// Its name in libtorch, with its overload: `aten::add.Tensor`.
    pub(super) operator: String,
    /// Its arguments, by their names in libtorch.
    pub(super) arguments: BTreeMap<String, Argument>,
    pub(super) outputs: Vec<Value>,
}

/// A tensor that depends on an input.
#[derive(Debug, Deserialize)]
pub(super) struct Value {
    pub(super) id: usize,
    /// The number of its type in c10/core/ScalarType.h.
    pub(super) kind: i8,
    /// Its sizes; `None` where a size depends on the number of rows.
    pub(super) sizes: Vec<Option<i64>>,
}

/// An argument of an operator.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(super) enum Argument {
    Value(Value),
    Constant {
        /// Index in the graph's constants.
        constant: usize,
    },
    Bool(bool),
    Integer(i64),
    Number(f64),
    List(Vec<Argument>),
    None,
}

impl Graph {
    /// The graph of the module in the file `path`. `inputs` are examples of its inputs, `[1, size]` each.
    ///
    /// # Errors
    /// What libtorch says.
    pub(super) fn read(path: &Path, inputs: &[Tensor]) -> Result<Self, TchError> {
        let path = CString::new(path.as_os_str().as_bytes())?;
        let inputs: Vec<*const c_void> = inputs.iter().map(|input| input.as_ptr().cast()).collect();
        let mut message = [0_u8; 4096];
        // SAFETY: each pointer is valid for the length that is passed with it, and the tensors live during the call. The
        // function catches every C++ exception.
        let graph = unsafe {
            let (room, message) = (message.len(), message.as_mut_ptr().cast());
            comic_graph_read(path.as_ptr(), inputs.as_ptr(), inputs.len(), message, room)
        };
        if graph.is_null() {
            let said = String::from_utf8_lossy(&message);
            return Err(TchError::Torch(said.trim_end_matches('\0').to_owned()));
        }
        // SAFETY: `graph` is a graph until it is freed, at the end. Its JSON lives as long and is copied before. Each constant is
        // a new tensor of libtorch that nothing else owns, like those that the bindings make.
        let (json, constants) = unsafe {
            let mut length = 0;
            let json = comic_graph_json(graph, &raw mut length);
            let json = std::slice::from_raw_parts(json, length).to_vec();
            let constants = (0..comic_graph_constants(graph))
                .map(|index| Tensor::from_ptr(comic_graph_constant(graph, index).cast()))
                .collect();
            comic_graph_free(graph);
            (json, constants)
        };
        let read: Self = serde_json::from_slice(&json).map_err(|error| TchError::FileFormat(error.to_string()))?;
        Ok(Self { constants, ..read })
    }
}
