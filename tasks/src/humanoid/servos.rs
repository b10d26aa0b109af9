//! The position servos of both bodies (`locomotion/walkers/cmu_humanoid.py`: `_POSITION_ACTUATORS` and
//! `_POSITION_ACTUATORS_V2020`), in the order of the control vector: alphabetical by joint.

/// One joint's position servo.
pub(super) struct Servo {
    /// The joint it drives; the servo has the same name.
    pub(super) joint: &'static str,
    /// Proportional gain (N·m/rad).
    pub(super) gain: f64,
    /// Torque limit in both directions (N·m).
    pub(super) limit: f64,
    /// Damping of the joint (N·m·s/rad); the damping of the joint's class when absent.
    pub(super) damping: Option<f64>,
}

/// A servo of V2020.
const fn servo(joint: &'static str, gain: f64, damping: f64) -> Servo {
    Servo { joint, gain, limit: gain, damping: Some(damping) }
}

/// A servo of V2019: the damping is that of the joint's class.
const fn bare(joint: &'static str, gain: f64, limit: f64) -> Servo {
    Servo { joint, gain, limit, damping: None }
}

/// Time constant of the filter between the control and a V2020 servo, s (`dynprm`).
pub(super) const FILTER_TIME_CONSTANT: f64 = 0.03;

/// The V2020 body's servos.
pub(super) const V2020: [Servo; 56] = [
    servo("headrx", 40.0, 2.0),
    servo("headry", 40.0, 2.0),
    servo("headrz", 40.0, 2.0),
    servo("lclaviclery", 80.0, 20.0),
    servo("lclaviclerz", 80.0, 20.0),
    servo("lfemurrx", 300.0, 15.0),
    servo("lfemurry", 200.0, 10.0),
    servo("lfemurrz", 200.0, 10.0),
    servo("lfingersrx", 20.0, 1.0),
    servo("lfootrx", 120.0, 6.0),
    servo("lfootrz", 50.0, 3.0),
    servo("lhandrx", 20.0, 1.0),
    servo("lhandrz", 20.0, 1.0),
    servo("lhumerusrx", 120.0, 6.0),
    servo("lhumerusry", 120.0, 6.0),
    servo("lhumerusrz", 120.0, 6.0),
    servo("lowerbackrx", 300.0, 15.0),
    servo("lowerbackry", 180.0, 20.0),
    servo("lowerbackrz", 200.0, 20.0),
    servo("lowerneckrx", 120.0, 20.0),
    servo("lowerneckry", 120.0, 20.0),
    servo("lowerneckrz", 120.0, 20.0),
    servo("lradiusrx", 90.0, 5.0),
    servo("lthumbrx", 20.0, 1.0),
    servo("lthumbrz", 20.0, 1.0),
    servo("ltibiarx", 160.0, 8.0),
    servo("ltoesrx", 20.0, 1.0),
    servo("lwristry", 20.0, 1.0),
    servo("rclaviclery", 80.0, 20.0),
    servo("rclaviclerz", 80.0, 20.0),
    servo("rfemurrx", 300.0, 15.0),
    servo("rfemurry", 200.0, 10.0),
    servo("rfemurrz", 200.0, 10.0),
    servo("rfingersrx", 20.0, 1.0),
    servo("rfootrx", 120.0, 6.0),
    servo("rfootrz", 50.0, 3.0),
    servo("rhandrx", 20.0, 1.0),
    servo("rhandrz", 20.0, 1.0),
    servo("rhumerusrx", 120.0, 6.0),
    servo("rhumerusry", 120.0, 6.0),
    servo("rhumerusrz", 120.0, 6.0),
    servo("rradiusrx", 90.0, 5.0),
    servo("rthumbrx", 20.0, 1.0),
    servo("rthumbrz", 20.0, 1.0),
    servo("rtibiarx", 160.0, 8.0),
    servo("rtoesrx", 20.0, 1.0),
    servo("rwristry", 20.0, 1.0),
    servo("thoraxrx", 300.0, 15.0),
    servo("thoraxry", 80.0, 8.0),
    servo("thoraxrz", 200.0, 12.0),
    servo("upperbackrx", 300.0, 15.0),
    servo("upperbackry", 80.0, 8.0),
    servo("upperbackrz", 200.0, 12.0),
    servo("upperneckrx", 60.0, 10.0),
    servo("upperneckry", 60.0, 10.0),
    servo("upperneckrz", 60.0, 10.0),
];

/// The V2019 body's servos.
pub(super) const V2019: [Servo; 56] = [
    bare("headrx", 20.0, 20.0),
    bare("headry", 20.0, 20.0),
    bare("headrz", 20.0, 20.0),
    bare("lclaviclery", 20.0, 20.0),
    bare("lclaviclerz", 20.0, 20.0),
    bare("lfemurrx", 120.0, 120.0),
    bare("lfemurry", 80.0, 80.0),
    bare("lfemurrz", 80.0, 80.0),
    bare("lfingersrx", 20.0, 20.0),
    bare("lfootrx", 50.0, 50.0),
    bare("lfootrz", 50.0, 50.0),
    bare("lhandrx", 20.0, 20.0),
    bare("lhandrz", 20.0, 20.0),
    bare("lhumerusrx", 60.0, 60.0),
    bare("lhumerusry", 60.0, 60.0),
    bare("lhumerusrz", 60.0, 60.0),
    bare("lowerbackrx", 150.0, 120.0),
    bare("lowerbackry", 150.0, 120.0),
    bare("lowerbackrz", 150.0, 120.0),
    bare("lowerneckrx", 20.0, 20.0),
    bare("lowerneckry", 20.0, 20.0),
    bare("lowerneckrz", 20.0, 20.0),
    bare("lradiusrx", 60.0, 60.0),
    bare("lthumbrx", 20.0, 20.0),
    bare("lthumbrz", 20.0, 20.0),
    bare("ltibiarx", 80.0, 80.0),
    bare("ltoesrx", 20.0, 20.0),
    bare("lwristry", 20.0, 20.0),
    bare("rclaviclery", 20.0, 20.0),
    bare("rclaviclerz", 20.0, 20.0),
    bare("rfemurrx", 120.0, 120.0),
    bare("rfemurry", 80.0, 80.0),
    bare("rfemurrz", 80.0, 80.0),
    bare("rfingersrx", 20.0, 20.0),
    bare("rfootrx", 50.0, 50.0),
    bare("rfootrz", 50.0, 50.0),
    bare("rhandrx", 20.0, 20.0),
    bare("rhandrz", 20.0, 20.0),
    bare("rhumerusrx", 60.0, 60.0),
    bare("rhumerusry", 60.0, 60.0),
    bare("rhumerusrz", 60.0, 60.0),
    bare("rradiusrx", 60.0, 60.0),
    bare("rthumbrx", 20.0, 20.0),
    bare("rthumbrz", 20.0, 20.0),
    bare("rtibiarx", 80.0, 80.0),
    bare("rtoesrx", 20.0, 20.0),
    bare("rwristry", 20.0, 20.0),
    bare("thoraxrx", 100.0, 80.0),
    bare("thoraxry", 100.0, 80.0),
    bare("thoraxrz", 100.0, 80.0),
    bare("upperbackrx", 80.0, 80.0),
    bare("upperbackry", 80.0, 80.0),
    bare("upperbackrz", 80.0, 80.0),
    bare("upperneckrx", 20.0, 20.0),
    bare("upperneckry", 20.0, 20.0),
    bare("upperneckrz", 20.0, 20.0),
];
