//! Every number of a compiled model by its name, for the comparison with dm_control's.

use mujoco_rs::mujoco_c::mjModel;

/// The values of field `name`, as f64 (every integer of a model is exact in one), `len` of them for an array.
/// `None` for a name that the table does not have.
///
/// # Safety
/// `len` must be the length of that array in `model`.
#[allow(unsafe_code)]
pub(crate) unsafe fn values(model: &mjModel, name: &str, len: usize) -> Option<Vec<f64>> {
    macro_rules! table {
        (scalars { $($scalar:ident)* } flags { $($flag:ident)* } arrays { $($array:ident)* }) => {
            match name {
                $(stringify!($scalar) => Some(vec![model.$scalar as f64]),)*
                $(stringify!($flag) => Some(vec![f64::from(u8::from(model.$flag))]),)*
                $(stringify!($array) => {
                    if len == 0 {
                        return Some(Vec::new());
                    }
                    // SAFETY: the caller vouches for the length; MuJoCo allocates every array of positive length.
                    let slice = unsafe { std::slice::from_raw_parts(model.$array, len) };
                    Some(slice.iter().map(|value| value.number()).collect())
                })*
                _ => None,
            }
        };
    }
    table! {
        scalars {
            nB nC nD nJfe nJfv nJmom nJten nM na nactuator narena nbody nbuffer nbvh nbvhdynamic nbvhstatic ncam
            nconmax nefm0L nefm0dof nefmCvert nemax neq nexclude nflex nflexbending nflexedge nflexelem
            nflexelemdata nflexelemedge nflexnode nflexshelldata nflexstiffness nflextexcoord nflexvert ngeom
            ngravcomp nhfield nhfielddata nhistory njmax njnt nkey nlight nmat nmesh nmeshdegmax nmeshface
            nmeshgraph nmeshnormal nmeshpoly nmeshpolymap nmeshpolyvert nmeshtexcoord nmeshvert nmocap nnames
            nnames_map nnumeric nnumericdata noct nout npair npaths nplugin npluginattr npluginstate npolygonmax nq
            nsensor nsensordata nsite nskin nskinbone nskinbonevert nskinface nskintexvert nskinvert ntendon ntex
            ntexdata ntext ntextdata ntree ntuple ntupledata nu nuser_actuator nuser_body nuser_cam nuser_geom
            nuser_jnt nuser_sensor nuser_site nuser_tendon nuserdata nv nwrap
        }
        flags {
            flg_adhesion flg_gravcomp flg_surfacevel
        }
        arrays {
            B_colind B_rowadr B_rownnz D_colind D_diag D_rowadr D_rownnz M_colind M_rowadr M_rownnz actuator_actadr
            actuator_actnum actuator_biastype actuator_ctrladr actuator_ctrlnum actuator_ctrlspec actuator_dyntype
            actuator_gaintype actuator_group actuator_history actuator_historyadr actuator_outadr actuator_outnum
            actuator_plugin actuator_trnid actuator_trntype body_bvhadr body_bvhnum body_conaffinity body_contype
            body_dofadr body_dofnum body_geomadr body_geomnum body_jntadr body_jntnum body_mocapid body_parentid
            body_plugin body_rootid body_treeid body_weldid bvh_child bvh_depth bvh_nodeid cam_bodyid cam_mode
            cam_output cam_projection cam_resolution cam_targetbodyid dof_Madr dof_bodyid dof_jntid dof_parentid
            dof_simplenum dof_treeid efm0_L_colind efm0_L_rowadr efm0_L_rownnz efm0_dofid efmC_perm eq_obj1id
            eq_obj2id eq_objtype eq_type exclude_signature flex_activelayers flex_bendingadr flex_bvhadr flex_bvhnum
            flex_cellnum flex_conaffinity flex_condim flex_contype flex_dim flex_edge flex_edgeadr flex_edgeequality
            flex_edgeflap flex_edgenum flex_elem flex_elemadr flex_elemdataadr flex_elemedge flex_elemedgeadr
            flex_elemlayer flex_elemnum flex_elemtexcoord flex_group flex_interp flex_matid flex_nodeadr
            flex_nodebodyid flex_nodenum flex_passive flex_priority flex_selfcollide flex_shell flex_shelldataadr
            flex_shellnum flex_stiffnessadr flex_texcoordadr flex_vertadr flex_vertbodyid flex_vertedge
            flex_vertedgeadr flex_vertedgenum flex_vertnum flexedge_J_colind flexedge_J_rowadr flexedge_J_rownnz
            flexvert_J_colind flexvert_J_rowadr flexvert_J_rownnz geom_bodyid geom_conaffinity geom_condim
            geom_contype geom_dataid geom_group geom_matid geom_plugin geom_priority geom_type hfield_adr
            hfield_ncol hfield_nrow hfield_pathadr jnt_actuatorid jnt_bodyid jnt_dofadr jnt_group jnt_qposadr
            jnt_type light_bodyid light_mode light_targetbodyid light_texid light_type mapD2M mapM2D mapM2M
            mat_texid mesh_bvhadr mesh_bvhnum mesh_extrema mesh_face mesh_faceadr mesh_facenormal mesh_facenum
            mesh_facetexcoord mesh_graph mesh_graphadr mesh_normaladr mesh_normalnum mesh_octadr mesh_octnum
            mesh_pathadr mesh_polyadr mesh_polymap mesh_polymapadr mesh_polymapnum mesh_polynum mesh_polyvert
            mesh_polyvertadr mesh_polyvertnum mesh_texcoordadr mesh_texcoordnum mesh_vertadr mesh_vertnum
            name_actuatoradr name_bodyadr name_camadr name_eqadr name_excludeadr name_flexadr name_geomadr
            name_hfieldadr name_jntadr name_keyadr name_lightadr name_matadr name_meshadr name_numericadr
            name_pairadr name_pluginadr name_sensoradr name_siteadr name_skinadr name_tendonadr name_texadr
            name_textadr name_tupleadr numeric_adr numeric_size oct_child oct_depth pair_dim pair_geom1 pair_geom2
            pair_signature plugin plugin_attradr plugin_stateadr plugin_statenum sensor_adr sensor_datatype
            sensor_dim sensor_history sensor_historyadr sensor_intprm sensor_needstage sensor_objid sensor_objtype
            sensor_plugin sensor_refid sensor_reftype sensor_type site_bodyid site_dataid site_group site_matid
            site_type skin_boneadr skin_bonebodyid skin_bonenum skin_bonevertadr skin_bonevertid skin_bonevertnum
            skin_face skin_faceadr skin_facenum skin_group skin_matid skin_pathadr skin_texcoordadr skin_vertadr
            skin_vertnum ten_J_colind ten_J_rowadr ten_J_rownnz tendon_actuatorid tendon_adr tendon_group
            tendon_matid tendon_num tendon_treeid tendon_treenum tex_colorspace tex_contenttypeadr tex_height
            tex_nchannel tex_pathadr tex_type tex_width text_adr text_size tree_bodyadr tree_bodynum tree_dofadr
            tree_dofnum tree_sleep_policy tuple_adr tuple_objid tuple_objtype tuple_size wrap_objid wrap_type
            actuator_acc0 actuator_actrange actuator_armature actuator_biasprm actuator_cranklength
            actuator_ctrlrange actuator_damping actuator_dampingpoly actuator_delay actuator_dynprm
            actuator_forcerange actuator_gainprm actuator_gear actuator_length0 actuator_lengthrange actuator_user
            body_gravcomp body_inertia body_invweight0 body_ipos body_iquat body_margin body_mass body_pos body_quat
            body_subtreemass body_user cam_fovy cam_ipd cam_mat0 cam_pos cam_pos0 cam_poscom0 cam_quat cam_user
            dof_M0 dof_armature dof_damping dof_dampingpoly dof_frictionloss dof_invweight0 dof_length dof_solimp
            dof_solref efm0_L eq_data eq_solimp eq_solref flex_bending flex_damping flex_edgedamping
            flex_edgestiffness flex_friction flex_gap flex_margin flex_node flex_node0 flex_radius flex_size
            flex_solimp flex_solmix flex_solref flex_stiffness flex_vert flex_vert0 flex_vertmetric
            flexedge_invweight0 flexedge_length0 geom_aabb geom_adhesion geom_fluid geom_friction geom_gap
            geom_margin geom_pos geom_quat geom_rbound geom_size geom_solimp geom_solmix geom_solref geom_surfacevel
            geom_user hfield_size jnt_actfrcrange jnt_axis jnt_margin jnt_pos jnt_range jnt_solimp jnt_solref
            jnt_stiffness jnt_stiffnesspoly jnt_user key_act key_ctrl key_mpos key_mquat key_qpos key_qvel key_time
            light_dir light_dir0 light_pos light_pos0 light_poscom0 mesh_polynormal mesh_pos mesh_quat mesh_scale
            numeric_data oct_aabb oct_coeff pair_adhesion pair_friction pair_gap pair_margin pair_solimp pair_solref
            pair_solreffriction qpos0 qpos_spring sensor_cutoff sensor_delay sensor_interval sensor_noise
            sensor_user site_pos site_quat site_size site_user tendon_actfrcrange tendon_armature tendon_damping
            tendon_dampingpoly tendon_frictionloss tendon_invweight0 tendon_length0 tendon_lengthspring
            tendon_margin tendon_range tendon_solimp_fri tendon_solimp_lim tendon_solref_fri tendon_solref_lim
            tendon_stiffness tendon_stiffnesspoly tendon_user tendon_width tuple_objprm wrap_prm actuator_actearly
            actuator_actlimited actuator_ctrllimited actuator_forcelimited eq_active0 flex_centered flex_flatskin
            flex_rigid flexedge_rigid jnt_actfrclimited jnt_actgravcomp jnt_limited light_active light_castshadow
            mat_texuniform tendon_actfrclimited tendon_limited body_sameframe body_simple geom_sameframe
            site_sameframe cam_intrinsic cam_sensorsize flex_rgba flex_texcoord geom_rgba hfield_data light_ambient
            light_attenuation light_bulbradius light_cutoff light_diffuse light_exponent light_intensity light_range
            light_softness light_specular mat_emission mat_metallic mat_reflectance mat_rgba mat_roughness
            mat_shininess mat_specular mat_texrepeat mesh_normal mesh_texcoord mesh_vert site_rgba skin_bonebindpos
            skin_bonebindquat skin_bonevertweight skin_inflate skin_rgba skin_texcoord skin_vert tendon_rgba
            plugin_attr tex_adr
        }
    }
}

trait Number {
    fn number(&self) -> f64;
}

macro_rules! number {
    ($($kind:ty),*) => { $(impl Number for $kind { fn number(&self) -> f64 { *self as f64 } })* };
}
number!(f64, f32, i32, i64, u8, i8);

impl Number for bool {
    fn number(&self) -> f64 {
        f64::from(u8::from(*self))
    }
}
