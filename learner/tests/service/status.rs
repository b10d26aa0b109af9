//! The status of the learner, and the evaluations that actors report.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use crate::support::{EPOCH, RUN, World};
use comic_learner::observe::evaluation::Evaluation;
use comic_proto::v1::{EvaluationReport, StatusRequest};
use tonic::Code;

#[tokio::test]
async fn the_status_holds_the_newest_metrics() {
    let world = World::start().await;
    let mut client = world.client().await;
    let status = client.get_status(StatusRequest {}).await.unwrap().into_inner();
    assert_eq!((status.learner_epoch, status.metrics_json.as_str()), (EPOCH, "{}"));
    world.service.trainer().set_metrics(r#"{"updates": 7}"#.into());
    let status = client.get_status(StatusRequest {}).await.unwrap().into_inner();
    assert_eq!(status.metrics_json, r#"{"updates": 7}"#);
}

#[tokio::test]
async fn reported_evaluations_wait_for_the_trainer_in_order_and_in_limited_number() {
    let world = World::start().await;
    let mut client = world.client().await;
    let report = |version| EvaluationReport {
        run: Some(RUN),
        learner_epoch: EPOCH,
        version,
        updates: 7,
        environment_steps: 900,
        seconds: 1.5,
        json: "{}".into(),
        film: b"GIF89a"[..].into(),
    };
    for version in 0..4 {
        client.report_evaluation(report(version)).await.unwrap();
    }
    assert_eq!(client.report_evaluation(report(4)).await.unwrap_err().code(), Code::ResourceExhausted);
    let evaluation = |version| Evaluation {
        run: RUN,
        epoch: EPOCH,
        version,
        updates: 7,
        environment_steps: 900,
        seconds: 1.5,
        json: "{}".into(),
        film: b"GIF89a"[..].into(),
    };
    assert_eq!(world.service.trainer().take_evaluations(), (0..4).map(evaluation).collect::<Vec<_>>());
    assert!(client.report_evaluation(report(5)).await.is_ok());
}

#[tokio::test]
async fn a_report_that_is_no_json_is_refused() {
    let world = World::start().await;
    let json = "{broken".into();
    let report = EvaluationReport { run: Some(RUN), learner_epoch: EPOCH, json, ..EvaluationReport::default() };
    let refused = world.client().await.report_evaluation(report).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(world.service.trainer().take_evaluations().is_empty());
}
