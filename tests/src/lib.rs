//! comic-tests
