//! Renders the overlays of the Kubernetes manifests with kubectl, and reads them strictly.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Container, Namespace, PersistentVolumeClaim, PodSpec, Service};
use k8s_openapi::api::networking::v1::NetworkPolicy;
use k8s_openapi::api::policy::v1::PodDisruptionBudget;
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::repository::root;

/// Manifests by kind and name.
pub type Manifests = BTreeMap<(String, String), Value>;

/// The folder of the base and the overlays.
pub fn directory() -> PathBuf {
    root().join("deploy/kubernetes")
}

/// Every directory that a user may apply: the base and each overlay.
///
/// # Errors
/// When the directories cannot be listed.
pub fn applicable() -> Result<Vec<PathBuf>> {
    let overlays = directory().join("overlays");
    let entries = fs::read_dir(&overlays).with_context(|| format!("cannot list {}", overlays.display()))?;
    let mut found = entries.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>>>()?;
    ensure!(!found.is_empty(), "there are no overlays");
    found.push(directory().join("base"));
    Ok(found)
}

/// The manifests that `kubectl apply --kustomize DIRECTORY` applies.
///
/// # Errors
/// When kubectl, which `cargo xtask test` installs, does not exist or refuses the directory.
pub fn render(directory: &Path) -> Result<Manifests> {
    let kubectl = root().join(".deps/python/requirements-kubectl/bin/kubectl");
    ensure!(kubectl.exists(), "no file {}; `cargo xtask test` makes it", kubectl.display());
    let output = Command::new(kubectl).arg("kustomize").arg(directory).output().context("cannot start kubectl")?;
    ensure!(output.status.success(), "{}: {}", directory.display(), String::from_utf8_lossy(&output.stderr));
    manifests_in(str::from_utf8(&output.stdout)?)
}

/// The manifests of a file with several documents.
///
/// # Errors
/// A document that is no YAML, or no manifest.
pub fn manifests_in(text: &str) -> Result<Manifests> {
    let mut manifests = Manifests::new();
    for document in serde_yaml_ng::Deserializer::from_str(text) {
        // YAML's own value type refuses a field that is given twice.
        let document = serde_json::to_value(serde_yaml_ng::Value::deserialize(document)?)?;
        let name = |value: &Value| value.as_str().map(str::to_owned);
        let kind = name(&document["kind"]).context("a manifest without a kind")?;
        let name = name(&document["metadata"]["name"]).context("a manifest without a name")?;
        ensure!(manifests.insert((kind.clone(), name.clone()), document).is_none(), "{kind} {name} is there twice");
    }
    Ok(manifests)
}

/// A rendered overlay as Kubernetes' types.
#[derive(Debug)]
pub struct Cluster {
    /// The only namespace.
    pub namespace: Namespace,
    /// The learner's Service.
    pub service: Service,
    /// The claim for the learner's runs.
    pub claim: PersistentVolumeClaim,
    /// The learner's Job.
    pub learner: Job,
    /// The actors' Job.
    pub actors: Job,
    /// The evaluator's Job.
    pub evaluator: Job,
    /// The actors' PodDisruptionBudget.
    pub budget: PodDisruptionBudget,
    /// The network policies by name.
    pub policies: BTreeMap<String, NetworkPolicy>,
}

impl Cluster {
    /// Reads the rendered manifests.
    ///
    /// # Errors
    /// Fields or values that Kubernetes does not accept, and missing or additional manifests.
    pub fn read(mut manifests: Manifests) -> Result<Self> {
        let policies = manifests.extract_if(.., |(kind, _), _| kind == "NetworkPolicy");
        let policies = policies.map(|((_, name), manifest)| Ok((name, strictly(manifest)?))).collect::<Result<_>>()?;
        let cluster = Self {
            namespace: take(&mut manifests, "Namespace", "comic")?,
            service: take(&mut manifests, "Service", "comic-learner")?,
            claim: take(&mut manifests, "PersistentVolumeClaim", "comic-runs")?,
            learner: take(&mut manifests, "Job", "comic-learner")?,
            actors: take(&mut manifests, "Job", "comic-actor")?,
            evaluator: take(&mut manifests, "Job", "comic-evaluator")?,
            budget: take(&mut manifests, "PodDisruptionBudget", "comic-actor")?,
            policies,
        };
        ensure!(manifests.is_empty(), "no test reads {:?}", manifests.keys());
        Ok(cluster)
    }

    /// The number of learners: 1, or as many as the learner's Indexed Job has pods, and as the learners are told.
    ///
    /// # Errors
    /// When these numbers differ.
    pub fn ranks(&self) -> Result<usize> {
        let job = self.learner.spec.as_ref().context("no spec")?;
        let told = option(container(self.learner_pod()?)?, "--world-size").ok().map(str::parse::<i32>).transpose()?;
        let numbers = [told, job.parallelism, job.completions];
        let indexed = job.completion_mode.as_deref() == Some("Indexed");
        match told {
            None => ensure!(numbers == [None; 3] && !indexed, "more than one learner: {numbers:?}"),
            Some(size) => ensure!(size > 1 && numbers == [told; 3] && indexed, "{numbers:?} learners"),
        }
        Ok(usize::try_from(told.unwrap_or(1))?)
    }

    /// The host where actors begin: the learner's Service, or the pod of rank 0 behind it.
    ///
    /// # Errors
    /// When the number of learners is not clear.
    pub fn host(&self) -> Result<String> {
        let service = self.service.metadata.name.as_deref().unwrap_or_default();
        Ok(if self.ranks()? == 1 { service.to_owned() } else { format!("comic-learner-0.{service}") })
    }

    /// The learner's pod, the actors' pod and the evaluator's pod.
    ///
    /// # Errors
    /// When one is missing.
    pub fn pods(&self) -> Result<[&PodSpec; 3]> {
        Ok([self.learner_pod()?, self.actor_pod()?, self.evaluator_pod()?])
    }

    /// The learner's pod.
    ///
    /// # Errors
    /// When there is none.
    pub fn learner_pod(&self) -> Result<&PodSpec> {
        pod(&self.learner)
    }

    /// The actors' pod.
    ///
    /// # Errors
    /// When there is none.
    pub fn actor_pod(&self) -> Result<&PodSpec> {
        pod(&self.actors)
    }

    /// The evaluator's pod.
    ///
    /// # Errors
    /// When there is none.
    pub fn evaluator_pod(&self) -> Result<&PodSpec> {
        pod(&self.evaluator)
    }
}

fn pod(job: &Job) -> Result<&PodSpec> {
    let spec = job.spec.as_ref().context("no spec")?;
    spec.template.spec.as_ref().context("no pod")
}

/// Calls `check` with every overlay and with the base.
///
/// # Errors
/// The first overlay that cannot be read or does not pass.
pub fn each(check: impl Fn(&Cluster) -> Result<()>) -> Result<()> {
    for directory in applicable()? {
        let cluster = render(&directory).and_then(Cluster::read);
        cluster.and_then(|cluster| check(&cluster)).with_context(|| directory.display().to_string())?;
    }
    Ok(())
}

/// The only container of a pod.
///
/// # Errors
/// When the pod has no container, or several.
pub fn container(pod: &PodSpec) -> Result<&Container> {
    let [container] = &pod.containers[..] else { bail!("{} containers", pod.containers.len()) };
    ensure!(pod.init_containers.is_none() && pod.ephemeral_containers.is_none(), "other containers");
    Ok(container)
}

fn take<T: DeserializeOwned + Serialize>(manifests: &mut Manifests, kind: &str, name: &str) -> Result<T> {
    let manifest = manifests.remove(&(kind.to_owned(), name.to_owned()));
    strictly(manifest.with_context(|| format!("no {kind} {name}"))?).with_context(|| format!("{kind} {name}"))
}

/// Reads a manifest as its type. A field that the type does not have would be lost.
///
/// # Errors
/// When a field is lost, with its path, or when a value does not fit the type.
pub fn strictly<T: DeserializeOwned + Serialize>(manifest: Value) -> Result<T> {
    let typed: T = serde_json::from_value(manifest.clone())?;
    keeps(&manifest, &serde_json::to_value(&typed)?, "")?;
    Ok(typed)
}

/// Checks that every written field is in the value that was read.
fn keeps(written: &Value, read: &Value, at: &str) -> Result<()> {
    match (written, read) {
        (Value::Object(written), Value::Object(read)) => written.iter().try_for_each(|(name, value)| {
            let at = format!("{at}.{name}");
            keeps(value, read.get(name).with_context(|| format!("{at} is no field that Kubernetes knows"))?, &at)
        }),
        (Value::Array(written), Value::Array(read)) if written.len() == read.len() => {
            let mut pairs = written.iter().zip(read).enumerate();
            pairs.try_for_each(|(index, (written, read))| keeps(written, read, &format!("{at}[{index}]")))
        }
        (written, read) if written == read => Ok(()),
        (written, read) => bail!("{at} is {written} and is read as {read}"),
    }
}

/// The value of an option of a container's program.
///
/// # Errors
/// When the option is not given.
pub fn option<'a>(container: &'a Container, name: &str) -> Result<&'a str> {
    let args = container.args.as_deref().unwrap_or_default();
    let at = args.iter().position(|arg| arg == name).with_context(|| format!("no {name} in {args:?}"))?;
    Ok(args.get(at + 1).with_context(|| format!("no value of {name}"))?)
}

/// The environment variables of a container that have a literal value.
pub fn environment(container: &Container) -> BTreeMap<&str, &str> {
    let variables = container.env.iter().flatten();
    variables.filter_map(|variable| Some((variable.name.as_str(), variable.value.as_deref()?))).collect()
}

/// The number that a quantity stands for, in the units that the manifests use.
///
/// # Errors
/// Another unit.
pub fn amount(Quantity(text): &Quantity) -> Result<f64> {
    let units = [("m", 1e-3), ("Mi", 2f64.powi(20)), ("Gi", 2f64.powi(30))];
    let unit = units.iter().find_map(|(unit, factor)| Some((text.strip_suffix(unit)?, *factor)));
    let (number, factor) = unit.unwrap_or((text, 1.0));
    Ok(number.parse::<f64>().with_context(|| format!("{text} is no quantity"))? * factor)
}
