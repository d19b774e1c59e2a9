// What the page of an avatar uses of three.js; tools/bundle_three.sh makes three.min.js of it.
export {
  AnimationMixer, Box3, BufferGeometry, Color, DirectionalLight, Float32BufferAttribute, Fog, HemisphereLight,
  LineBasicMaterial, LineSegments, LoopOnce, PerspectiveCamera, Scene, SkeletonHelper, Vector3, WebGLRenderer,
} from 'three';
export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
export { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
