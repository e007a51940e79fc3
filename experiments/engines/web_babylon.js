// Babylon.js: window.draw(url of a GLB, views, size) -> a data URL per view
import {
  Color3, Color4, Engine, FreeCamera, Light, Matrix, PointLight, Scene, SceneLoader, Vector3,
} from "@babylonjs/core";
import "@babylonjs/loaders/glTF/2.0/index.js";

window.draw = async (url, views, size) => {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = size;
  const engine = new Engine(canvas, true, { preserveDrawingBuffer: true, alpha: true });
  engine.setSize(size, size);
  const scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(0, 0, 0, 0);
  scene.ambientColor = new Color3(0, 0, 0);
  await SceneLoader.AppendAsync("", url, scene, undefined, ".glb");
  scene.imageProcessingConfiguration.toneMappingEnabled = false;
  scene.imageProcessingConfiguration.exposure = 1;
  scene.imageProcessingConfiguration.contrast = 1;
  const lamp = new PointLight("lamp", new Vector3(0, 0, 0), scene);
  lamp.falloffType = Light.FALLOFF_PHYSICAL;
  lamp.intensityMode = Light.INTENSITYMODE_LUMINOUSINTENSITY;
  lamp.radius = 0;
  const camera = new FreeCamera("camera", new Vector3(0, 0, 0), scene);
  scene.activeCamera = camera;
  await scene.whenReadyAsync();
  const out = [];
  for (const v of views) {
    camera.fov = (v.fov * Math.PI) / 180;
    camera.minZ = v.near;
    camera.maxZ = v.far;
    const eye = new Vector3(...v.eye);
    const view = Matrix.LookAtRH(eye, eye.add(new Vector3(...v.forward)), new Vector3(...v.up));
    camera.position.copyFrom(eye);
    camera.getViewMatrix = () => view;
    camera._computedViewMatrix = view;
    lamp.position.set(...v.light);
    lamp.intensity = v.intensity;
    scene.render();
    scene.render();
    out.push(canvas.toDataURL("image/png"));
  }
  engine.dispose();
  return out;
};
window.ready = true;
