//! The registration of metrics: one call gives the metric, its help text and its line of the reference page.

use comic_experiment::TaskName;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Metric, Registry};

/// One label and its value.
type Label = [(&'static str, &'static str); 1];

/// The description of a metric.
#[derive(Debug)]
pub(super) struct Description {
    pub(super) name: &'static str,
    pub(super) kind: &'static str,
    pub(super) label: Option<&'static str>,
    pub(super) values: &'static [&'static str],
    pub(super) help: &'static str,
}

#[derive(Debug, Default)]
pub(super) struct Catalogue {
    pub(super) registry: Registry,
    pub(super) descriptions: Vec<Description>,
}

impl Catalogue {
    fn add<M: Metric + Clone>(&mut self, kind: &'static str, name: &'static str, help: &'static str, metric: M) -> M {
        self.registry.register(name, help, metric.clone());
        self.descriptions.push(Description { name, kind, label: None, values: &[], help });
        metric
    }

    pub(super) fn counter(&mut self, name: &'static str, help: &'static str) -> Counter {
        self.add("counter", name, help, Counter::default())
    }

    pub(super) fn gauge(&mut self, name: &'static str, help: &'static str) -> Gauge {
        self.add("gauge", name, help, Gauge::default())
    }

    pub(super) fn histogram(
        &mut self,
        name: &'static str,
        help: &'static str,
        buckets: impl IntoIterator<Item = f64>,
    ) -> Histogram {
        self.add("histogram", name, help, Histogram::new(buckets))
    }

    /// One metric for each value of a label; all of them exist from the beginning.
    pub(super) fn labelled<M: Metric + Clone + Default>(
        &mut self,
        kind: &'static str,
        (name, label): (&'static str, &'static str),
        values: &'static [&'static str],
        help: &'static str,
    ) -> Labelled<M>
    where
        Family<Label, M>: Metric,
    {
        let family = Family::<Label, M>::default();
        for value in values {
            drop(family.get_or_create(&[(label, *value)]));
        }
        self.registry.register(name, help, family.clone());
        self.descriptions.push(Description { name, kind, label: Some(label), values, help });
        Labelled { family, label }
    }

    /// One metric for each task, learnt or not.
    pub(super) fn of_tasks<M: Metric + Clone + Default>(
        &mut self,
        kind: &'static str,
        name: &'static str,
        help: &'static str,
    ) -> Labelled<M>
    where
        Family<Label, M>: Metric,
    {
        self.labelled(kind, (name, "task"), &TASKS, help)
    }
}

/// Every task's name.
pub(super) static TASKS: [&str; TaskName::ALL.len()] = {
    let (mut names, mut at) = ([""; TaskName::ALL.len()], 0);
    while at < names.len() {
        names[at] = TaskName::ALL[at].name();
        at += 1;
    }
    names
};

/// A metric with one label.
#[derive(Clone, Debug)]
pub(crate) struct Labelled<M> {
    family: Family<Label, M>,
    label: &'static str,
}

impl<M: Clone + Default> Labelled<M> {
    pub(crate) fn of(&self, value: &'static str) -> M {
        self.family.get_or_create_owned(&[(self.label, value)])
    }
}
