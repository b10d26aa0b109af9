//! The overlay `kueue`: the base's Jobs in a queue. The tests of all overlays check the rest.

use anyhow::{Context, Result, ensure};
use comic_tests::kubernetes::{directory, render};
use serde_json::json;

const QUEUE: &str = "kueue.x-k8s.io/queue-name";
const ELASTIC: &str = "kueue.x-k8s.io/elastic-job";

/// A field `suspend` would stop a run at the next `kubectl apply`, because Kueue changes it.
#[test]
fn the_overlay_adds_only_the_queue_and_that_the_actors_number_may_change() -> Result<()> {
    let mut queued = render(&directory().join("overlays/kueue"))?;
    for ((_, name), job) in queued.iter_mut().filter(|((kind, _), _)| kind == "Job") {
        let metadata = job["metadata"].as_object_mut().context("no metadata")?;
        let queue = metadata.get_mut("labels").and_then(|labels| labels.as_object_mut()?.remove(QUEUE));
        ensure!(queue == Some(json!("comic")), "{name} is in the queue {queue:?}");
        let annotations = metadata.remove("annotations");
        let expected = (name == "comic-actor").then(|| json!({ ELASTIC: "true" }));
        ensure!(annotations == expected, "{name}: {annotations:?}");
    }
    ensure!(queued == render(&directory().join("base"))?, "something else differs from the base: {queued:?}");
    Ok(())
}
