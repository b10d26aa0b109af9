//! TensorBoard's messages, with the few fields that are used: those of `event.proto`, `summary.proto` and `tensor.proto`, and
//! of the plugins for hyperparameters (`hparams/plugin_data.proto`, `hparams/api.proto`).

use std::collections::BTreeMap;

use bytes::Bytes;

/// `Summary.Image.colorspace` of RGB.
const RGB: i32 = 3;

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    pub(super) wall_time: f64,
    #[prost(int64, tag = "2")]
    pub(super) step: i64,
    #[prost(string, optional, tag = "3")]
    pub(super) file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    pub(super) summary: Option<Summary>,
    #[prost(message, optional, tag = "7")]
    pub(super) session_log: Option<SessionLog>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct SessionLog {
    #[prost(int32, tag = "1")]
    pub(super) status: i32,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Summary {
    #[prost(message, repeated, tag = "1")]
    pub(super) values: Vec<SummaryValue>,
}

/// A point of a curve, an image, or what a plugin shows: `Summary.Value`.
#[derive(Clone, PartialEq, prost::Message)]
pub(in crate::observe) struct SummaryValue {
    #[prost(string, tag = "1")]
    pub(in crate::observe) tag: String,
    /// Optional, so that 0 is written too.
    #[prost(float, optional, tag = "2")]
    pub(in crate::observe) simple_value: Option<f32>,
    #[prost(message, optional, tag = "4")]
    pub(in crate::observe) image: Option<Image>,
    #[prost(message, optional, tag = "8")]
    pub(super) tensor: Option<Tensor>,
    #[prost(message, optional, tag = "9")]
    pub(super) metadata: Option<SummaryMetadata>,
}

/// An encoded image: `Summary.Image`.
#[derive(Clone, PartialEq, prost::Message)]
pub(in crate::observe) struct Image {
    /// Pixels.
    #[prost(int32, tag = "1")]
    pub(in crate::observe) height: i32,
    /// Pixels.
    #[prost(int32, tag = "2")]
    pub(in crate::observe) width: i32,
    #[prost(int32, tag = "3")]
    pub(in crate::observe) colorspace: i32,
    /// A PNG or GIF file.
    #[prost(bytes = "bytes", tag = "4")]
    pub(in crate::observe) encoded_image_string: Bytes,
}

/// `TensorProto`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Tensor {
    /// `DataType`.
    #[prost(int32, tag = "1")]
    pub(super) dtype: i32,
    #[prost(message, optional, tag = "2")]
    pub(super) shape: Option<Shape>,
    #[prost(string, repeated, tag = "8")]
    pub(super) strings: Vec<String>,
}

/// `TensorShapeProto`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Shape {
    #[prost(message, repeated, tag = "2")]
    pub(super) dimensions: Vec<Dimension>,
}

/// `TensorShapeProto.Dim`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Dimension {
    #[prost(int64, tag = "1")]
    pub(super) size: i64,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct SummaryMetadata {
    #[prost(message, optional, tag = "1")]
    pub(super) plugin: Option<PluginData>,
    /// `DataClass`.
    #[prost(int32, tag = "4")]
    pub(super) data_class: i32,
}

/// `SummaryMetadata.PluginData`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PluginData {
    #[prost(string, tag = "1")]
    pub(super) name: String,
    /// A message of the plugin's own.
    #[prost(bytes = "vec", tag = "2")]
    pub(super) content: Vec<u8>,
}

/// `HParamsPluginData`: one of the two.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Hyperparameters {
    #[prost(message, optional, tag = "2")]
    pub(super) columns: Option<Columns>,
    #[prost(message, optional, tag = "3")]
    pub(super) row: Option<Row>,
}

/// The columns of the table of runs: `Experiment`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Columns {
    #[prost(message, repeated, tag = "4")]
    pub(super) fields: Vec<Field>,
    #[prost(message, repeated, tag = "5")]
    pub(super) metrics: Vec<Metric>,
}

/// `HParamInfo`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Field {
    #[prost(string, tag = "1")]
    pub(super) name: String,
    /// `DataType`.
    #[prost(int32, tag = "4")]
    pub(super) data_type: i32,
    /// Whether the column is among those that are shown first.
    #[prost(bool, tag = "7")]
    pub(super) differs: bool,
}

/// `MetricInfo`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Metric {
    #[prost(message, optional, tag = "1")]
    pub(super) name: Option<MetricName>,
}

/// `MetricName`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct MetricName {
    #[prost(string, tag = "2")]
    pub(super) tag: String,
}

/// A run's row of the table: `SessionStartInfo`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Row {
    #[prost(btree_map = "string, message", tag = "1")]
    pub(super) fields: BTreeMap<String, FieldValue>,
    /// Seconds since 1970.
    #[prost(double, tag = "5")]
    pub(super) start_time: f64,
}

/// `google.protobuf.Value`: one of the three, also if it is 0, empty or false.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct FieldValue {
    #[prost(double, optional, tag = "2")]
    pub(super) number: Option<f64>,
    #[prost(string, optional, tag = "3")]
    pub(super) text: Option<String>,
    #[prost(bool, optional, tag = "4")]
    pub(super) boolean: Option<bool>,
}

impl SummaryValue {
    /// A point of the curve `tag`.
    pub(in crate::observe) fn scalar(tag: String, value: f64) -> Self {
        Self { tag, simple_value: Some(value as f32), ..Self::default() }
    }

    /// An image in colour, a PNG or GIF file of this width and height in pixels.
    pub(in crate::observe) fn image(tag: &str, (width, height): (u16, u16), file: Bytes) -> Self {
        let image = Image { height: height.into(), width: width.into(), colorspace: RGB, encoded_image_string: file };
        Self { tag: tag.to_owned(), image: Some(image), ..Self::default() }
    }
}
