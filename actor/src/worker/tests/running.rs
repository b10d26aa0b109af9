//! The running worker: what it waits for, and what ends it.

use super::*;

#[test]
fn in_lockstep_a_version_makes_one_unroll_of_every_environment() {
    let environments = vec![Counter::new(&[3]), Counter::new(&[4])];
    let worker = Worker::new(environments, Plain::default(), layout(4), 0, 3).unwrap();
    let mailbox = Mailbox::default();
    let publish = |learner_epoch, version| {
        mailbox.publish(Directive { learner_epoch, version, parameters: Bytes::from_static(b"1") });
    };
    // The channel has room for more unrolls than the worker makes.
    let (sender, mut receiver) = mpsc::channel(16);
    std::thread::scope(|scope| {
        let running = scope.spawn(|| {
            let sender = sender;
            worker.run(Pace::Lockstep, &mailbox, &sender, &Progress::default())
        });
        // The same version again is not new; the first version of a restarted learner is.
        for (learner_epoch, version) in [(1, 1), (1, 2), (2, 1)] {
            publish(learner_epoch, version);
            for environment in 0..2 {
                let unroll = receiver.blocking_recv().unwrap();
                let made = (unroll.learner_epoch, unroll.version, unroll.environment);
                assert_eq!(made, (learner_epoch, version, environment));
            }
            publish(learner_epoch, version);
        }
        mailbox.close();
        running.join().unwrap().unwrap();
        assert!(receiver.blocking_recv().is_none(), "the worker made too many unrolls");
    });
}

#[test]
fn a_closed_mailbox_ends_the_worker_and_a_full_channel_holds_it() {
    let layout = layout(4);
    let worker = Worker::new(vec![Counter::new(&[3])], Plain::default(), layout, 0, 3).unwrap();
    let mailbox = Mailbox::default();
    mailbox.publish(Directive { learner_epoch: 1, version: 1, parameters: Bytes::from_static(b"1") });
    let progress = Progress::default();
    let (sender, mut receiver) = mpsc::channel(1);
    std::thread::scope(|scope| {
        let running = scope.spawn(|| {
            let sender = sender;
            worker.run(Pace::Free, &mailbox, &sender, &progress)
        });
        for _ in 0..3 {
            receiver.blocking_recv().unwrap();
        }
        // At most one unroll waits in the channel, and the worker holds one.
        assert!(progress.steps.load(Ordering::Relaxed) <= 4 * 5);
        mailbox.close();
        // The waiting unrolls are dropped together with their tickets.
        drop(receiver);
        running.join().unwrap().unwrap();
    });
}
