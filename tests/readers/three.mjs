// Prints what three.js makes of a file: its clips, and all vertices in the world at some times of a clip, morphed and skinned.
// Arguments: FILE CLIP TIME... (seconds).
import { readFileSync } from 'node:fs';
import * as THREE from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';

const [file, name, ...times] = process.argv.slice(2);
const bytes = readFileSync(file);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().parseAsync(buffer, '');
let mesh = null;
gltf.scene.traverse((object) => { if (object.isSkinnedMesh) mesh = object; });
const mixer = new THREE.AnimationMixer(gltf.scene);
const action = mixer.clipAction(THREE.AnimationClip.findByName(gltf.animations, name));
action.setLoop(THREE.LoopOnce);
action.clampWhenFinished = true;
const frames = times.map((time) => {
  action.reset().play();
  mixer.setTime(Number(time));
  gltf.scene.updateMatrixWorld(true);
  mesh.skeleton.update();
  const vertex = new THREE.Vector3();
  const frame = [];
  for (let index = 0; index < mesh.geometry.attributes.position.count; index++) {
    mesh.getVertexPosition(index, vertex).applyMatrix4(mesh.matrixWorld);
    frame.push(vertex.toArray());
  }
  return frame;
});
console.log(JSON.stringify({
  clips: gltf.animations.map((clip) => ({
    name: clip.name,
    duration: clip.duration,
    keys: Math.max(...clip.tracks.map((track) => track.times.length)),
  })),
  bones: mesh.skeleton.bones.map((bone) => bone.name),
  morphs: Object.keys(mesh.morphTargetDictionary ?? {}),
  hasColors: 'color' in mesh.geometry.attributes,
  frames,
}));
