//! wip
/// wip
#[derive(clap::Args, Debug)]
pub struct Bench {}
impl Bench { /// wip
pub fn run(&self)->Result<(),crate::Error>{Ok(())} }
