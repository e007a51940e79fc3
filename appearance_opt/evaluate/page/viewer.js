// The 3D viewer. three.js and the scenes lie in the page, compressed; they are unpacked when the
// viewer comes into sight.
(() => {
  const root = document.querySelector('#viewer');
  if (!root) return;
  const holder = root.querySelector('.canvas'), message = root.querySelector('.message');
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  async function unpack(text) {
    const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream('gzip'));
    return new Response(stream).arrayBuffer();
  }
  const text = (id) => document.getElementById(id).textContent;
  const picture = (data) => new Promise((done, failed) => {
    const image = new Image();
    image.onload = () => done(image);
    image.onerror = () => failed(new Error('a texture of this page cannot be shown'));
    image.src = `data:image/webp;base64,${data}`;
  });
  const TYPES = { int16: Int16Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };

  async function start() {
    if (!window.DecompressionStream) throw new Error('this browser is too old to unpack the scene');
    new Function(new TextDecoder().decode(await unpack(text('three-js'))))(); // defines window.THREE
    const THREE = window.THREE;
    const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    renderer.outputEncoding = THREE.sRGBEncoding;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setScissorTest(true);
    const canvas = renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute('aria-label', '3D view: drag or arrow keys turn it, wheel or + and - zoom');

    const sky = JSON.parse(text('sky'));
    const half = new Uint16Array(await unpack(sky.data));
    const panorama = new THREE.DataTexture(half, sky.width, sky.height, THREE.RGBAFormat, THREE.HalfFloatType);
    panorama.mapping = THREE.EquirectangularReflectionMapping;
    panorama.minFilter = panorama.magFilter = THREE.LinearFilter;
    panorama.needsUpdate = true;
    const environment = new THREE.PMREMGenerator(renderer).fromEquirectangular(panorama).texture;

    const scenes = {};
    for (const element of document.querySelectorAll('script.scene'))
      scenes[element.dataset.name] = await build(THREE, JSON.parse(element.textContent));
    const camera = new THREE.PerspectiveCamera(28, 1, 0.05, 50);
    const lamp = new THREE.DirectionalLight(0xffffff, 0.85); // three.js of this age multiplies by pi
    let azimuth = sky.azimuth, elevation = sky.elevation, distance = 4.2;
    const target = new THREE.Vector3();
    const value = (name) => root.querySelector(`input[name=${name}]:checked`).value;
    const divider = root.querySelector('.divider'), place = root.querySelector('#divide');

    let waiting = false;
    const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
    function draw() {
      waiting = false;
      const width = holder.clientWidth, height = holder.clientHeight;
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      // the whole ball around the asset fits, in narrow windows, too
      camera.fov = 28 * Math.max(1, 1 / camera.aspect) ** 0.9;
      camera.updateProjectionMatrix();
      const c = Math.cos(elevation);
      const away = new THREE.Vector3(Math.sin(azimuth) * c, Math.sin(elevation), Math.cos(azimuth) * c);
      camera.position.copy(target).addScaledVector(away, distance);
      camera.lookAt(target);
      lamp.position.copy(camera.position);
      const show = value('show'), look = value('look'), light = value('light');
      holder.dataset.show = show;
      root.querySelector('.divide').hidden = show !== 'both';
      const x = (width * place.value) / 100;
      divider.style.left = `${x}px`;
      const parts = show === 'both' ? [['original', 0, x], ['result', x, width]] : [[show, 0, width]];
      for (const [name, from, to] of parts) {
        const scene = scenes[name];
        scene.dress(look, light === 'environment' ? environment : null);
        if (light === 'lamp') scene.add(lamp); else scene.remove(lamp);
        renderer.setViewport(0, 0, width, height);
        renderer.setScissor(from, 0, Math.max(to - from, 0), height);
        renderer.render(scene, camera);
      }
    }
    for (const input of root.querySelectorAll('input')) input.addEventListener('input', redraw);
    new ResizeObserver(redraw).observe(holder);

    const turn = (dx, dy) => {
      azimuth -= dx;
      elevation = Math.min(Math.max(elevation + dy, -1.55), 1.55);
      redraw();
    };
    const dolly = (factor) => { distance = Math.min(Math.max(distance * factor, 0.3), 12); redraw(); };
    const pan = (dx, dy) => {
      const m = camera.matrixWorld.elements, s = distance * 0.5;
      target.addScaledVector(new THREE.Vector3(m[0], m[1], m[2]), -dx * s);
      target.addScaledVector(new THREE.Vector3(m[4], m[5], m[6]), dy * s);
      target.clampLength(0, 1);
      redraw();
    };
    root.querySelector('#upright').addEventListener('click', () => {
      [azimuth, elevation, distance] = [sky.azimuth, sky.elevation, 4.2];
      target.set(0, 0, 0);
      redraw();
    });
    const fingers = new Map();
    canvas.addEventListener('pointerdown', (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, e);
    });
    canvas.addEventListener('pointermove', (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const size = holder.clientHeight;
      const dx = (e.clientX - before.clientX) / size, dy = (e.clientY - before.clientY) / size;
      if (fingers.size === 2) {
        const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
        const apart = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY);
        dolly(apart(before) / Math.max(apart(e), 1));
        pan(dx / 2, dy / 2);
      } else if (e.buttons === 2 || e.shiftKey) pan(dx, dy);
      else turn(5 * dx, 4 * dy);
      fingers.set(e.pointerId, e);
    });
    for (const end of ['pointerup', 'pointercancel'])
      canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
    canvas.addEventListener('contextmenu', (e) => e.preventDefault());
    canvas.addEventListener('wheel', (e) => {
      // pages scroll: the wheel belongs to the viewer once it has been touched
      if (document.activeElement !== canvas && !e.ctrlKey) return;
      e.preventDefault();
      dolly(Math.exp(e.deltaY / 600));
    }, { passive: false });
    const keys = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] };
    canvas.addEventListener('keydown', (e) => {
      if (keys[e.key]) turn(...keys[e.key]);
      else if (e.key === '+' || e.key === '=') dolly(0.85);
      else if (e.key === '-') dolly(1 / 0.85);
      else return;
      e.preventDefault();
    });
    message.remove();
    holder.prepend(canvas);
    redraw();
    root.dataset.ready = 'yes';
  }

  // A scene whose `dress` changes what its meshes wear.
  async function build(THREE, packed) {
    const header = JSON.parse(packed.header), data = await unpack(packed.data);
    const images = await Promise.all(packed.images.map(picture));
    const textures = new Map();
    const wraps = { repeat: THREE.RepeatWrapping, clamp: THREE.ClampToEdgeWrapping, mirror: THREE.MirroredRepeatWrapping };
    const texture = (t) => {
      if (!t) return null;
      const key = JSON.stringify(t);
      if (!textures.has(key)) {
        const made = new THREE.Texture(images[t.image]);
        made.flipY = false;
        made.encoding = t.srgb ? THREE.sRGBEncoding : THREE.LinearEncoding;
        [made.wrapS, made.wrapT] = t.wrap.map((w) => wraps[w]);
        made.anisotropy = 8;
        made.needsUpdate = true;
        textures.set(key, made);
      }
      return textures.get(key);
    };
    const array = ([type, offset, count, width, normalized]) =>
      new THREE.BufferAttribute(new TYPES[type](data, offset, count), width, normalized);
    const scene = new THREE.Scene();
    const wire = new THREE.MeshBasicMaterial({ color: 0x0b1d33, wireframe: true, transparent: true, opacity: 0.55 });
    for (const entry of header.meshes) {
      const geometry = new THREE.BufferGeometry(), m = header.materials[entry.material];
      for (const [name, where] of Object.entries(entry.attributes)) geometry.setAttribute(name, array(where));
      if (entry.attributes.uv) geometry.setAttribute('uv2', geometry.attributes.uv);
      geometry.setIndex(array(entry.index));
      geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(), 2);
      const colored = Boolean(entry.attributes.color);
      // without tangents three.js takes them from the picture, whose v runs downward
      const scale = new THREE.Vector2(m.normalScale, entry.attributes.tangent ? m.normalScale : -m.normalScale);
      const side = m.doubleSided ? THREE.DoubleSide : THREE.FrontSide;
      const color = new THREE.Color(...m.color), map = texture(m.map), orm = texture(m.orm);
      const through = { side, alphaTest: m.mask, transparent: m.blend, opacity: m.opacity, depthWrite: !m.blend };
      const own = m.unlit
        ? new THREE.MeshBasicMaterial({ ...through, color, map, vertexColors: colored })
        : new THREE.MeshStandardMaterial({
            ...through, color, map, vertexColors: colored, normalMap: texture(m.normal), normalScale: scale,
            roughness: m.roughness, metalness: m.metalness, roughnessMap: orm, metalnessMap: orm,
            aoMap: m.occlusion ? orm : null, emissive: new THREE.Color(...m.emission), emissiveMap: texture(m.emissive),
          });
      const channel = (letter, factor) => {
        const plain = new THREE.MeshBasicMaterial({ side, map: orm, color: orm ? 0xffffff : new THREE.Color(factor, factor, factor) });
        plain.onBeforeCompile = (shader) => {
          shader.fragmentShader = shader.fragmentShader
            .replace('#include <map_fragment>', `#ifdef USE_MAP\n diffuseColor.rgb = vec3(texture2D(map, vUv).${letter} * ${factor.toFixed(4)});\n#endif`)
            .replace('#include <encodings_fragment>', '');
        };
        plain.customProgramCacheKey = () => letter + factor;
        return plain;
      };
      const looks = {
        shaded: own,
        color: new THREE.MeshBasicMaterial({ ...through, color, map, vertexColors: colored }),
        normal: new THREE.MeshNormalMaterial({ side, normalMap: texture(m.normal), normalScale: scale }),
        roughness: channel('g', m.roughness),
        metalness: channel('b', m.metalness),
        shape: new THREE.MeshStandardMaterial({ side, color: 0xb4b4b4, roughness: 0.75 }),
      };
      looks.wireframe = looks.shaded;
      const solid = new THREE.Mesh(geometry, own), lines = new THREE.Mesh(geometry, wire);
      lines.visible = false;
      for (const look of Object.values(looks)) Object.assign(look, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
      solid.userData = { looks, lines };
      scene.add(solid, lines);
    }
    scene.dress = (look, light) => {
      scene.environment = light;
      for (const object of scene.children) {
        const { looks, lines } = object.userData;
        if (!looks) continue;
        object.material = looks[look];
        lines.visible = look === 'wireframe';
      }
    };
    return scene;
  }

  const begin = () => start().catch((fault) => { message.textContent = `The 3D view cannot be shown: ${fault.message.replace(/\.$/, "")}.`; });
  const watcher = new IntersectionObserver((entries) => {
    if (entries.some((e) => e.isIntersecting)) { watcher.disconnect(); begin(); }
  }, { rootMargin: '200px' });
  watcher.observe(root);
})();
