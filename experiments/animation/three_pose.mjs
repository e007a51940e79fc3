// Where three.js puts the vertices of a file: GLTFLoader, AnimationMixer, SkinnedMesh.
//   node three_pose.mjs FILE.glb CLIP SECONDS,... MODULES OUT.bin
// OUT: for each time the vertices (x, y, z, float64) of all meshes in the order of the scene, in
// the world; the numbers of vertices by mesh go to standard output as JSON. MODULES: a folder with
// node_modules/three.
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { pathToFileURL } from 'node:url';

const [file, clipName, seconds, modules, out] = process.argv.slice(2);
const at = (name) => pathToFileURL(join(modules, 'node_modules/three', name)).href;
// textures need a browser; positions do not
globalThis.self = globalThis;
globalThis.ProgressEvent ??= class {};
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} });
const THREE = await import(at('build/three.module.js'));
const { GLTFLoader } = await import(at('examples/jsm/loaders/GLTFLoader.js'));
THREE.ImageBitmapLoader.prototype.load = (url, done) => done({ width: 1, height: 1, close() {} });
THREE.TextureLoader.prototype.load = (url, done) => done(new THREE.Texture());

const data = readFileSync(file);
const buffer = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
const gltf = await new Promise((done, fail) => new GLTFLoader().parse(buffer, '', done, fail));
const clip = gltf.animations.find((a) => a.name === clipName);
if (!clip) throw new Error(`no clip '${clipName}': ${gltf.animations.map((a) => a.name)}`);
const mixer = new THREE.AnimationMixer(gltf.scene);
const action = mixer.clipAction(clip);
action.setLoop(THREE.LoopOnce);
action.clampWhenFinished = true;
action.play();

const meshes = [];
gltf.scene.traverse((node) => { if (node.isMesh) meshes.push(node); });
const values = [], p = new THREE.Vector3();
for (const time of seconds.split(',').map(Number)) {
  action.reset();
  mixer.setTime(time);
  gltf.scene.updateMatrixWorld(true);
  for (const mesh of meshes) {
    mesh.skeleton?.update();
    for (let k = 0; k < mesh.geometry.attributes.position.count; k++) {
      mesh.getVertexPosition(k, p); // with applyBoneTransform where there is a skin
      values.push(...p.applyMatrix4(mesh.matrixWorld).toArray());
    }
  }
}
writeFileSync(out, Buffer.from(new Float64Array(values).buffer));
console.log(JSON.stringify(meshes.map((m) => [m.name, m.geometry.attributes.position.count])));
