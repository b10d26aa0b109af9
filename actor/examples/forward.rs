//! x
use comic_actor::acting::*; use comic_actor::policy::*; use std::time::Instant;
fn main(){ use_one_torch_thread();
 let e=comic_experiment::Experiment::default(); let spec=comic_experiment::TaskSpec::tracking(&e.task, vec!["a".into()]).unwrap();
 let mut p=TorchPolicy::untrained(&spec,&e,1,||Ok([0.0;56])).unwrap();
 for n in [1,8,16,32,64]{ let mut b=ActingBatch::new(n,acting_sizes(&spec,&e)); 
  let mut v:Vec<f64>=vec![]; for _ in 0..60{ let t=Instant::now(); p.forward(&mut b).unwrap(); v.push(t.elapsed().as_secs_f64()*1e3);} v.sort_by(f64::total_cmp);
  println!("batch {n}: min {:.3} median {:.3} ms, per step {:.4}",v[0],v[30],v[30]/n as f64);
 let (k,o)=(1351i64,1024i64); let w=tch::Tensor::randn([o,k],(tch::Kind::Float,tch::Device::Cpu)); let x=tch::Tensor::randn([n as i64,k],(tch::Kind::Float,tch::Device::Cpu)); let wt=w.tr().contiguous(); let bias=tch::Tensor::zeros([o],(tch::Kind::Float,tch::Device::Cpu));
 let time=|f:&dyn Fn()->tch::Tensor|{let mut v:Vec<f64>=vec![]; for _ in 0..60{let t=Instant::now(); let _=f(); v.push(t.elapsed().as_secs_f64()*1e3);} v.sort_by(f64::total_cmp); (v[0],v[30])};
 println!("  linear {:?} mm-wt {:?} addmm {:?}", time(&||x.linear(&w,Some(&bias))), time(&||x.matmul(&wt)), time(&||bias.addmm(&x,&w.tr())));
 println!("  addmm contiguous wt {:?}; transposed product {:?}", time(&||bias.addmm(&x,&wt)), time(&||{ w.matmul(&x.tr()) }));
 }}
