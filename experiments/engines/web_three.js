// three.js: window.draw(url of a GLB, views, size) -> a data URL per view
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

window.draw = async (url, views, size) => {
  const canvas = document.createElement("canvas");
  const renderer = new THREE.WebGLRenderer({
    canvas, alpha: true, antialias: true, preserveDrawingBuffer: true,
  });
  renderer.setPixelRatio(1);
  renderer.setSize(size, size, false);
  renderer.setClearColor(0, 0);
  renderer.toneMapping = THREE.NoToneMapping;
  const scene = new THREE.Scene();
  scene.add((await new GLTFLoader().loadAsync(url)).scene);
  const lamp = new THREE.PointLight(0xffffff, 1, 0, 2);
  scene.add(lamp);
  return views.map((v) => {
    const camera = new THREE.PerspectiveCamera(v.fov, 1, v.near, v.far);
    camera.position.set(...v.eye);
    camera.up.set(...v.up);
    camera.lookAt(camera.position.clone().add(new THREE.Vector3(...v.forward)));
    lamp.position.set(...v.light);
    lamp.intensity = v.intensity;
    renderer.render(scene, camera);
    return canvas.toDataURL("image/png");
  });
};
window.ready = true;
