//! How much of the learner all peers together may use.

use clap::Args;

/// The limits of the service. Peers beyond a limit are refused and counted; the others are not disturbed.
#[derive(Clone, Debug, Args)]
pub struct ConnectionLimits {
    /// Actors at once; further actors are told to try again later. The limit of connections is twice this number plus 64.
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = positive, help_heading = "Limits")]
    pub max_actors: usize,
    /// Connections from one address; further connections are closed at once.
    #[arg(long, value_name = "N", default_value_t = 1024, value_parser = positive, help_heading = "Limits")]
    pub max_connections_per_address: usize,
    /// Calls in flight, including streams, of which an actor has two; further calls are refused.
    #[arg(long, value_name = "N", default_value_t = 16_384, value_parser = positive, help_heading = "Limits")]
    pub max_requests: usize,
    /// Bytes of a message to the learner [default: those of an unroll, at least 1 MiB].
    #[arg(long, value_name = "BYTES", value_parser = positive, help_heading = "Limits")]
    pub max_message_bytes: Option<usize>,
    /// Bytes of messages that were read and wait for a place in a batch, of all actors together; further messages stay unread.
    #[arg(long, value_name = "BYTES", default_value_t = INGEST, value_parser = positive, help_heading = "Limits")]
    pub max_ingest_bytes: usize,
    /// Bytes that a stream may have unread [default: those of an unroll]. Distant actors need more: this many bytes arrive in a
    /// round trip.
    #[arg(long, value_name = "BYTES", value_parser = clap::value_parser!(u32).range(65_535..1 << 31), help_heading = "Limits")]
    pub max_unread_bytes: Option<u32>,
}

/// Room for more than a thousand of the paper's unrolls.
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
    /// Connections at once, from all addresses. An actor that reconnects leaves its old connection open for a while, and status
    /// requests need connections too.
    pub fn max_connections(&self) -> usize {
        self.max_actors.saturating_mul(2).saturating_add(64)
    }
}

fn positive(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number @ 1..=0xffff_ffff) => Ok(number),
        _ => Err("must be a number of at least 1".into()),
    }
}
