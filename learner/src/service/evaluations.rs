//! Evaluations between the actors that report them and the trainer.

use std::collections::VecDeque;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::observe::evaluation::Evaluation;

/// Evaluations that may wait for the trainer. Each is at most as large as a message.
const CAPACITY: usize = 4;

/// A bounded queue of evaluations; a handle that can be cloned.
#[derive(Clone, Debug, Default)]
pub struct Evaluations {
    waiting: Arc<Mutex<VecDeque<Evaluation>>>,
}

impl Evaluations {
    /// Adds an evaluation. False if too many wait already.
    pub fn add(&self, evaluation: Evaluation) -> bool {
        let mut waiting = self.waiting.lock();
        let room = waiting.len() < CAPACITY;
        if room {
            waiting.push_back(evaluation);
        }
        room
    }

    /// Takes all evaluations that wait, oldest first.
    pub fn take(&self) -> Vec<Evaluation> {
        self.waiting.lock().drain(..).collect()
    }
}
