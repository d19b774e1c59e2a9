// Prints what three.js makes of a BVH file: its joints, and their positions in the world at some times. Arguments: FILE TIME...
import { readFileSync } from 'node:fs';
import * as THREE from 'three';
import { BVHLoader } from 'three/examples/jsm/loaders/BVHLoader.js';

const [file, ...times] = process.argv.slice(2);
const { skeleton, clip } = new BVHLoader().parse(readFileSync(file, 'utf8'));
const root = skeleton.bones[0];
const mixer = new THREE.AnimationMixer(root);
mixer.clipAction(clip).setLoop(THREE.LoopOnce).play();
mixer.clipAction(clip).clampWhenFinished = true;
const frames = times.map((time) => {
  mixer.setTime(Number(time));
  root.updateMatrixWorld(true);
  return skeleton.bones.map((bone) => bone.getWorldPosition(new THREE.Vector3()).toArray());
});
console.log(JSON.stringify({ bones: skeleton.bones.map((bone) => bone.name), duration: clip.duration, frames }));
