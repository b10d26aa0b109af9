//! An evaluation on its way to the learner.

use std::time::Duration;

use comic_proto::v1::EvaluationReport;
use comic_proto::v1::learner_client::LearnerClient;
use tonic::transport::Endpoint;

use crate::Error;

/// A learner that does not answer in this time is not there.
const PATIENCE: Duration = Duration::from_secs(10);

/// Reports an evaluation to the learner at `url`, which keeps it with the run.
///
/// # Errors
/// [`Error::Url`], or [`Error::Refused`] with the learner's or the network's reason.
pub(super) fn deliver(url: &str, report: EvaluationReport) -> Result<(), Error> {
    let endpoint = Endpoint::from_shared(url.to_string()).map_err(|_| Error::Url { url: url.to_string() })?;
    let endpoint = endpoint.connect_timeout(PATIENCE).timeout(PATIENCE);
    let refused = |message: String| Error::Refused { url: url.to_string(), message };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(Error::Thread)?;
    runtime.block_on(async {
        let channel = endpoint.connect().await.map_err(|error| refused(error.to_string()))?;
        LearnerClient::new(channel)
            .report_evaluation(report)
            .await
            .map(drop)
            .map_err(|status| refused(status.message().to_string()))
    })
}
