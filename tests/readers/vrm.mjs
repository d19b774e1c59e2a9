// Prints what three-vrm makes of a model: its bones at rest and vertices in the world, at rest, after one bone was turned, and with
// one expression. With a .vrma file, also the vertices at some times of its motion.
// Arguments: FILE BONE ANGLE (radians, about z) EXPRESSION [VRMA TIME...].
import { readFileSync } from 'node:fs';
import * as THREE from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { VRMLoaderPlugin } from '@pixiv/three-vrm';
import { VRMAnimationLoaderPlugin, createVRMAnimationClip } from '@pixiv/three-vrm-animation';

const [file, bone, angle, expression, motion, ...times] = process.argv.slice(2);
const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
loader.register((parser) => new VRMAnimationLoaderPlugin(parser));
async function load(path) {
  const bytes = readFileSync(path);
  return loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength), '');
}
const gltf = await load(file);
const vrm = gltf.userData.vrm;
let mesh = null;
gltf.scene.traverse((object) => { if (object.isSkinnedMesh) mesh = object; });
function vertices() {
  vrm.update(0);
  gltf.scene.updateMatrixWorld(true);
  mesh.skeleton.update();
  const vertex = new THREE.Vector3();
  return Array.from({ length: mesh.geometry.attributes.position.count }, (_, index) => (
    mesh.getVertexPosition(index, vertex).applyMatrix4(mesh.matrixWorld).toArray()));
}
const rest = vertices();
const places = {};
for (const name of Object.keys(vrm.humanoid.humanBones)) {
  places[name] = vrm.humanoid.getRawBoneNode(name).getWorldPosition(new THREE.Vector3()).toArray();
}
const node = vrm.humanoid.getNormalizedBoneNode(bone);
node.rotation.z = Number(angle);
const turned = vertices();
node.rotation.z = 0;
let shaped = null;
if (expression) {
  vrm.expressionManager.setValue(expression, 1);
  shaped = vertices();
  vrm.expressionManager.setValue(expression, 0);
}
let frames = [];
if (motion) {
  const [animation] = (await load(motion)).userData.vrmAnimations;
  const mixer = new THREE.AnimationMixer(gltf.scene);
  const clip = createVRMAnimationClip(animation, vrm);
  const action = mixer.clipAction(clip);
  action.setLoop(THREE.LoopOnce);
  action.clampWhenFinished = true;
  frames = times.map((time) => {
    action.reset().play();
    mixer.setTime(Number(time));
    return vertices();
  });
}
console.log(JSON.stringify({
  meta: vrm.meta,
  places,
  normalized: vrm.humanoid.normalizedRestPose,
  expressions: vrm.expressionManager ? Object.keys(vrm.expressionManager.customExpressionMap) : [],
  rest, turned, shaped, frames,
}));
