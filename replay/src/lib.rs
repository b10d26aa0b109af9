//! comic-replay
