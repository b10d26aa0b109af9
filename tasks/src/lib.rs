//! comic-tasks
