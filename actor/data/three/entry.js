// What page.js uses of three.js. README.md says how three.js in this directory is made of it.
export {
  BoxBufferGeometry, CanvasTexture, CylinderBufferGeometry, DirectionalLight, Group, HemisphereLight, LatheBufferGeometry, Mesh,
  MeshStandardMaterial, PCFSoftShadowMap, PerspectiveCamera, PlaneBufferGeometry, Quaternion, RepeatWrapping, Scene,
  SphereBufferGeometry, Vector2, Vector3, WebGLRenderer,
} from "three/build/three.module.js";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
