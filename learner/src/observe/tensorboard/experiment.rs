//! The experiment for TensorBoard: a row of the table of runs (the plugin `hparams`), and a text (the plugin `text`).

use std::collections::BTreeSet;

use comic_experiment::Experiment;
use prost::Message as _;
use toml::{Table, Value};

use super::messages::{
    Columns, Dimension, Field, FieldValue, Hyperparameters, Metric, MetricName, PluginData, Row, Shape,
    SummaryMetadata, SummaryValue, Tensor,
};
use crate::error::Result;

/// The metric in the table of runs.
const METRIC: &str = "evaluation/normalised_reward";
/// Sections that say how long and where an experiment runs, not what it is. Their columns are not among the first.
const CIRCUMSTANCES: [&str; 3] = ["budget.", "learner.", "actor."];
/// `DataType` of `tensor.proto`.
const FLOATS: i32 = 1;
const STRINGS: i32 = 7;
/// `DataClass.DATA_CLASS_TENSOR`.
const TENSOR: i32 = 2;
/// `DataType` of `hparams/api.proto`.
const TEXT: i32 = 1;
const BOOLEAN: i32 = 2;
const NUMBER: i32 = 3;

/// The table's columns, this run's row, and the experiment's text. The run starts at `start_time`, in seconds since 1970.
///
/// TensorBoard takes the columns of one of the runs that it shows. All experiments have the same fields.
///
/// # Errors
/// When the experiment has a number that TOML cannot write.
pub(super) fn values(experiment: &Experiment, start_time: f64) -> Result<Vec<SummaryValue>> {
    let text = experiment.to_toml()?;
    let mut fields = Vec::new();
    collect("", &text.parse::<Table>().unwrap_or_default(), &mut fields);
    let differences = Experiment::default().differences(experiment)?;
    let describes_it = |field: &String| !CIRCUMSTANCES.iter().any(|section| field.starts_with(section));
    let differing: BTreeSet<String> =
        differences.into_iter().map(|difference| difference.field).filter(describes_it).collect();
    let column = |(name, value): &(String, FieldValue)| Field {
        name: name.clone(),
        data_type: data_type(value),
        differs: differing.contains(name),
    };
    let metric = Metric { name: Some(MetricName { tag: METRIC.to_owned() }) };
    let columns = Columns { fields: fields.iter().map(column).collect(), metrics: vec![metric] };
    let row = Row { fields: fields.into_iter().collect(), start_time };
    Ok(vec![
        table("_hparams_/experiment", Hyperparameters { columns: Some(columns), row: None }),
        table("_hparams_/session_start_info", Hyperparameters { columns: None, row: Some(row) }),
        code("experiment", &text),
    ])
}

/// Collects every field that is no section, with its dotted name. Arrays are their text.
fn collect(prefix: &str, section: &Table, fields: &mut Vec<(String, FieldValue)>) {
    for (key, value) in section {
        let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        match value {
            Value::Table(section) => collect(&name, section, fields),
            Value::Boolean(value) => fields.push((name, FieldValue { boolean: Some(*value), ..FieldValue::default() })),
            Value::Integer(value) => fields.push((name, number(*value as f64))),
            Value::Float(value) => fields.push((name, number(*value))),
            Value::String(value) => fields.push((name, text(value.clone()))),
            Value::Datetime(_) | Value::Array(_) => fields.push((name, text(value.to_string()))),
        }
    }
}

fn number(value: f64) -> FieldValue {
    FieldValue { number: Some(value), ..FieldValue::default() }
}

fn text(value: String) -> FieldValue {
    FieldValue { text: Some(value), ..FieldValue::default() }
}

fn data_type(value: &FieldValue) -> i32 {
    match value {
        FieldValue { number: Some(_), .. } => NUMBER,
        FieldValue { boolean: Some(_), .. } => BOOLEAN,
        _ => TEXT,
    }
}

/// A part of the table of runs. It is in the metadata; the tensor is empty.
fn table(tag: &str, part: Hyperparameters) -> SummaryValue {
    let shape = Shape { dimensions: vec![Dimension { size: 0 }] };
    let tensor = Tensor { dtype: FLOATS, shape: Some(shape), strings: Vec::new() };
    of_plugin(tag, "hparams", part.encode_to_vec(), tensor)
}

/// A block of code in Markdown: lines that begin with four spaces, which no text can end.
fn code(tag: &str, text: &str) -> SummaryValue {
    let lines: String = text.lines().map(|line| format!("    {line}\n")).collect();
    let tensor = Tensor { dtype: STRINGS, shape: Some(Shape::default()), strings: vec![lines] };
    of_plugin(tag, "text", Vec::new(), tensor)
}

fn of_plugin(tag: &str, plugin: &str, content: Vec<u8>, tensor: Tensor) -> SummaryValue {
    let plugin = PluginData { name: plugin.to_owned(), content };
    let metadata = SummaryMetadata { plugin: Some(plugin), data_class: TENSOR };
    SummaryValue { tag: tag.to_owned(), tensor: Some(tensor), metadata: Some(metadata), ..SummaryValue::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a value says to the plugin `hparams`.
    fn part(value: &SummaryValue) -> Hyperparameters {
        let plugin = value.metadata.clone().unwrap().plugin.unwrap();
        assert_eq!(plugin.name, "hparams");
        Hyperparameters::decode(plugin.content.as_slice()).unwrap()
    }

    #[test]
    fn every_field_is_a_column_and_those_that_are_not_the_papers_come_first() {
        let overrides = ["vmpo.epsilon_eta=0.25", "budget.updates=3", "unroll.lockstep=true", "unroll.ahead=0"];
        let overrides = overrides.map(String::from);
        let experiment = comic_experiment::resolve("tracking-mlp", &overrides).unwrap();
        let values = values(&experiment, 1.5).unwrap();
        let [columns, row, _] = values.as_slice() else { panic!("{} values", values.len()) };
        let (columns, row) = (part(columns).columns.unwrap(), part(row).row.unwrap());
        assert_eq!(row.fields["vmpo.epsilon_eta"], number(0.25));
        assert_eq!(row.fields["unroll.lockstep"].boolean, Some(true));
        assert_eq!(row.fields["unroll.ahead"].number, Some(0.0), "a field that is 0 is there too");
        assert_eq!(row.fields["network.encoder"].text, Some(format!("{:?}", experiment.network.encoder)));
        assert_eq!(row.start_time, 1.5);
        let column = |name: &str| columns.fields.iter().find(|field| field.name == name).unwrap();
        assert_eq!((column("vmpo.epsilon_eta").data_type, column("vmpo.epsilon_eta").differs), (NUMBER, true));
        assert_eq!((column("vmpo.epsilon_mean").data_type, column("vmpo.epsilon_mean").differs), (NUMBER, false));
        assert!(!column("budget.updates").differs);
        assert_eq!((column("unroll.lockstep").data_type, column("network.encoder").data_type), (BOOLEAN, TEXT));
        assert_eq!(columns.fields.len(), row.fields.len());
    }

    #[test]
    fn the_text_is_one_block_of_code_whatever_a_string_holds() {
        let experiment = Experiment { name: "```\n<b>bold</b>".into(), ..Experiment::default() };
        let values = values(&experiment, 0.0).unwrap();
        let text = &values[2].tensor.as_ref().unwrap().strings[0];
        assert!(text.contains("bold") && text.lines().all(|line| line.starts_with("    ")), "{text}");
    }
}
