//! Sends an evaluation to the learner.

use std::time::Duration;

use comic_proto::v1::EvaluationReport;
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::{Access, chain, distrusted, no_connection};
use tonic::Code;

use crate::Error;

/// A learner that does not answer in this time counts as unreachable.
const PATIENCE: Duration = Duration::from_secs(10);

/// Reports an evaluation to the learner at `url`, which stores it with the run.
///
/// # Errors
/// [`Error::Access`], [`Error::Unwelcome`], [`Error::Refused`] with the learner's reason, or [`Error::Unreachable`].
pub(super) fn deliver(url: &str, access: &Access, report: EvaluationReport) -> Result<(), Error> {
    let (endpoint, bearer) = (access.endpoint(url)?.timeout(PATIENCE), access.bearer()?);
    let failed = |error: &(dyn std::error::Error + 'static), message| {
        let url = url.to_string();
        if distrusted(error) { Error::Unwelcome { url, message } } else { Error::Unreachable { url, message } }
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(Error::Thread)?;
    runtime.block_on(async {
        let channel = endpoint.connect().await.map_err(|error| failed(&error, no_connection(&error)))?;
        let answer = LearnerClient::with_interceptor(channel, bearer).report_evaluation(report).await;
        answer.map(drop).map_err(|status| {
            let (url, message) = (url.to_string(), status.message().to_string());
            match status.code() {
                Code::Unauthenticated => Error::Unwelcome { url, message },
                Code::InvalidArgument | Code::Unimplemented => Error::Refused { url, message },
                _ => failed(&status, chain(&status)),
            }
        })
    })
}
