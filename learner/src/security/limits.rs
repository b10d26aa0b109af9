//! How much of the learner its peers may take together.

use clap::Args;

/// ConnectionLimits of the service; beyond each, peers are refused and counted, and those inside go on undisturbed.
#[derive(Clone, Debug, Args)]
pub struct ConnectionLimits {
    /// Actors at once; one more is told to come again later. Connections in all are twice as many and 64.
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = positive, help_heading = "ConnectionLimits")]
    pub max_actors: usize,
    /// Connections from one address; one more is closed at once.
    #[arg(long, value_name = "N", default_value_t = 1024, value_parser = positive, help_heading = "ConnectionLimits")]
    pub max_connections_per_address: usize,
    /// Calls in flight, streams included, of which an actor has two; one more is refused.
    #[arg(long, value_name = "N", default_value_t = 16_384, value_parser = positive, help_heading = "ConnectionLimits")]
    pub max_requests: usize,
    /// Bytes of a message to the learner; as many as an unroll takes, and at least 1 MiB, unless given.
    #[arg(long, value_name = "BYTES", value_parser = positive, help_heading = "ConnectionLimits")]
    pub max_message_bytes: Option<usize>,
    /// Bytes of messages that were read and wait for a place in a batch, of all actors together; what is beyond stays unread.
    #[arg(long, value_name = "BYTES", default_value_t = INGEST, value_parser = positive, help_heading = "ConnectionLimits")]
    pub max_ingest_bytes: usize,
    /// Bytes that a stream may have under way unread; as many as an unroll has, unless given. More for actors that are far away:
    /// so many arrive in a round trip.
    #[arg(long, value_name = "BYTES", value_parser = clap::value_parser!(u32).range(65_535..1 << 31), help_heading = "ConnectionLimits")]
    pub max_unread_bytes: Option<u32>,
}

/// More than a thousand of the paper's unrolls.
const INGEST: usize = 256 * 1024 * 1024;

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self {
            max_actors: 4096,
            max_connections_per_address: 1024,
            max_requests: 16_384,
            max_message_bytes: None,
            max_ingest_bytes: INGEST,
            max_unread_bytes: None,
        }
    }
}

impl ConnectionLimits {
    /// Connections at once, from all addresses: an actor that reconnects leaves its old one behind for a while, and
    /// whoever asks for the status needs one too.
    pub fn max_connections(&self) -> usize {
        self.max_actors.saturating_mul(2).saturating_add(64)
    }
}

fn positive(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number @ 1..=0xffff_ffff) => Ok(number),
        _ => Err("must be a number from 1 on".into()),
    }
}
