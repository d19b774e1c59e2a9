// The page of an avatar: it unpacks the character in the page and plays its clips. Nothing is loaded from anywhere.
'use strict';
(() => {
  const {
    AnimationMixer, Box3, BufferGeometry, Color, DirectionalLight, Float32BufferAttribute, Fog, GLTFLoader, HemisphereLight,
    LineBasicMaterial, LineSegments, LoopOnce, OrbitControls, PerspectiveCamera, Scene, SkeletonHelper, Vector3, WebGLRenderer,
  } = SnarfThree;
  const BACKGROUND = '#d9dde1';
  const CLAY = [0.62, 0.50, 0.42];  // linear; the colour of `snarf export format=glb`
  const CELLS = 40;  // of the floor, along each side
  const SAMPLES = 5;  // moments of each clip from which the floor and the first view follow
  const LONGEST_STEP_S = 0.1;  // a page that was hidden goes on where it was
  const at = (id) => document.getElementById(id);
  const facts = JSON.parse(at('facts').textContent);

  // The character as a .glb file: text of base64, which holds a gzip stream.
  async function unpacked() {
    const text = atob(at('avatar').textContent.trim());
    const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
    return new Response(stream).arrayBuffer();
  }

  function renderer() {
    const made = new WebGLRenderer({ canvas: at('canvas'), antialias: true });
    made.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    return made;
  }

  function lightedScene() {
    const scene = new Scene();
    scene.background = new Color(BACKGROUND);
    scene.add(new HemisphereLight(0xffffff, 0xb5aca4, 2.0));
    for (const [x, y, z, strength] of [[2, 4, 3, 1.7], [-3, 2, -2, 0.9]]) {
      const light = new DirectionalLight(0xffffff, strength);
      light.position.set(x, y, z);
      scene.add(light);
    }
    return scene;
  }

  // A floor of squares. Each side is a line of its own: software that draws without a graphics card drops lines that begin
  // behind the camera.
  function floor(height, cell) {
    const corners = [];
    for (let a = -CELLS / 2; a <= CELLS / 2; a++) {
      for (let b = -CELLS / 2; b < CELLS / 2; b++) {
        corners.push(a * cell, height, b * cell, a * cell, height, (b + 1) * cell);
        corners.push(b * cell, height, a * cell, (b + 1) * cell, height, a * cell);
      }
    }
    const geometry = new BufferGeometry().setAttribute('position', new Float32BufferAttribute(corners, 3));
    return new LineSegments(geometry, new LineBasicMaterial({ color: '#9aa4ac' }));
  }

  // One clip at a time, at any moment of it.
  class Player {
    constructor(root, clips) {
      this.mixer = new AnimationMixer(root);
      this.clips = clips;
      this.time = 0;
      this.choose(0);
    }

    choose(number) {
      this.mixer.stopAllAction();
      const action = this.mixer.clipAction(this.clips[number]);
      action.setLoop(LoopOnce);
      action.clampWhenFinished = true;  // the last frame is a moment like others
      this.action = action;
      this.duration = this.clips[number].duration;
      this.show(0);
    }

    show(time) {
      this.time = time;
      this.action.reset().play();
      this.mixer.setTime(time);
    }

    advance(seconds) {
      if (this.duration > 0) this.show((this.time + seconds) % this.duration);
    }
  }

  // The box of the body over some moments of all clips, and around its first moment.
  function extent(root, mesh, player) {
    const all = new Box3();
    let first = null;
    for (let clip = player.clips.length - 1; clip >= 0; clip--) {  // the first one last: it stays
      player.choose(clip);
      for (let sample = SAMPLES - 1; sample >= 0; sample--) {
        player.show(player.duration * sample / Math.max(SAMPLES - 1, 1));
        root.updateMatrixWorld(true);
        mesh.skeleton.update();
        mesh.computeBoundingBox();
        first = mesh.boundingBox.clone().applyMatrix4(mesh.matrixWorld);
        all.union(first);
      }
    }
    return { all, first };
  }

  function bonesInColour() {
    facts.bones.forEach(({ name, color }) => {
      const row = document.createElement('li');
      const patch = document.createElement('span');
      patch.style.background = color;
      row.append(patch, name);
      at('bones').append(row);
    });
  }

  async function start() {
    const draw = renderer();
    const gltf = await new GLTFLoader().parseAsync(await unpacked(), '');
    const scene = lightedScene();
    scene.add(gltf.scene);
    let mesh = null;
    gltf.scene.traverse((object) => { if (object.isSkinnedMesh) mesh = object; });
    mesh.frustumCulled = false;
    const player = new Player(gltf.scene, gltf.animations);
    const { all, first } = extent(gltf.scene, mesh, player);
    const reach = first.getSize(new Vector3()).length();
    scene.add(floor(all.min.y, 10 ** Math.round(Math.log10(reach / 4))));  // metres: 1 for people, 0.1 for a mouse
    scene.fog = new Fog(BACKGROUND, 2 * reach, 8 * reach);  // fades the floor only
    mesh.material.fog = false;
    const bones = new SkeletonHelper(gltf.scene);
    bones.visible = false;
    scene.add(bones);

    const camera = new PerspectiveCamera(35, 1, reach / 100, 100 * reach);
    const orbit = new OrbitControls(camera, draw.domElement);
    first.getCenter(orbit.target);
    camera.position.set(0.45, 0.2, 1).setLength(1.9 * reach).add(orbit.target);
    orbit.maxDistance = 20 * reach;
    orbit.minDistance = 0.1 * reach;
    orbit.update();

    facts.clips.forEach((name, number) => at('clip').add(new Option(name, String(number))));
    bonesInColour();
    let isPlaying = true;
    const root = mesh.skeleton.bones[0];
    const place = root.getWorldPosition(new Vector3());

    function colour() {
      const isOn = at('weights').checked;
      mesh.material.vertexColors = isOn;
      mesh.material.color.setRGB(...(isOn ? [1, 1, 1] : CLAY));
      mesh.material.needsUpdate = true;
      at('bones').hidden = !isOn;
    }
    function play(isOn) {
      isPlaying = isOn;
      at('play').textContent = isOn ? 'Pause' : 'Play';
    }
    function show() {
      at('scrubber').max = String(player.duration);
      at('scrubber').value = String(player.time);
      at('scrubber').disabled = player.duration === 0;
      at('time').textContent = `${player.time.toFixed(2)} / ${player.duration.toFixed(2)} s`;
    }
    function follow() {
      const now = root.getWorldPosition(new Vector3());
      const moved = now.clone().sub(place).setY(0);
      place.copy(now);
      if (!at('follow').checked) return;
      camera.position.add(moved);
      orbit.target.add(moved);
    }

    at('clip').addEventListener('change', () => player.choose(Number(at('clip').value)));
    at('play').addEventListener('click', () => play(!isPlaying));
    at('scrubber').addEventListener('input', () => {
      play(false);
      player.show(Number(at('scrubber').value));
    });
    at('weights').addEventListener('change', colour);
    at('skeleton').addEventListener('change', () => { bones.visible = at('skeleton').checked; });
    at('controls').addEventListener('submit', (event) => event.preventDefault());
    document.addEventListener('keydown', (event) => {
      if (event.key !== ' ' || event.target !== document.body) return;
      event.preventDefault();
      play(!isPlaying);
    });

    let drawn = '';
    function fit() {  // the page, above its controls
      const [width, height] = [Math.max(window.innerWidth, 1), Math.max(window.innerHeight, 1)];
      const controls = at('controls').offsetHeight;  // their lines change with what they say
      const size = `${width} ${height} ${controls}`;
      if (size === drawn) return;
      drawn = size;
      draw.setSize(width, height, false);
      camera.aspect = width / height;
      camera.setViewOffset(width, height, 0, controls / 2, width, height);
      at('bones').style.bottom = `${controls + 20}px`;
    }

    let before = null;
    draw.setAnimationLoop((now) => {
      const passed = before === null ? 0 : Math.min((now - before) / 1000, LONGEST_STEP_S);
      before = now;
      if (isPlaying) player.advance(passed * Number(at('speed').value));
      fit();
      follow();
      orbit.update();
      draw.render(scene, camera);
      show();
    });
    colour();
    at('message').hidden = true;
    at('controls').hidden = false;
  }

  function fail(error) {
    const needs = 'This page needs WebGL 2 and a browser of 2023 or newer.';
    at('message').textContent = `The avatar cannot be shown: ${error && error.message ? error.message : error}. ${needs}`;
    console.error(error);
  }

  start().catch(fail);
})();
