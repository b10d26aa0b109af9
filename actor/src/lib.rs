//! comic-actor
