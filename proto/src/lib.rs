//! comic-proto
