//! comic-learner
