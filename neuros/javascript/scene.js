// A simulated world in 3-D: its geometry, once, and the poses of what moves, frame by frame.
// It draws with Three.js (the global THREE), and imports nothing, so that it fits into a page.

const SEGMENTS = 24;
const POSE = 7; // x, y, z; w, x, y, z of the quaternion
const CONTACT = 6; // point and normal
const MOST_CONTACTS = 500;
const STEP_BACK = 2.5; // from what the camera follows, in its reaches
const [SPOT, DIRECTIONAL] = [0, 1];
// MuJoCo adds up colours as they are, without a gamma; Three.js divides what falls on them by pi.
const LIGHT = Math.PI;

export function floats(text) {
  return new Float32Array(bytes(text).buffer);
}

function bytes(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

async function unpacked(text, Kind) {
  const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Kind(await new Response(stream).arrayBuffer());
}

export class Scene {
  // Args: the element to draw in, the geometry (see neuros/simulators/mujoco/scene.py).
  static async make(box, geometry) {
    const meshes = await Promise.all(geometry.meshes.map(meshGeometry));
    const textures = await Promise.all(geometry.textures.map(
      async (each) => ({...each, pixels: each.rgba && await unpacked(each.rgba, Uint8Array)})));
    return new Scene(box, geometry, meshes, textures);
  }

  constructor(box, geometry, meshes, textures) {
    THREE.ColorManagement.enabled = false;
    this.box = box;
    this.geometry = geometry;
    this.isDirty = true;
    this.root = new THREE.Scene();
    // Smooth edges are dear where there is no graphics card.
    const hasCard = document.createElement("canvas")
      .getContext("webgl2", {failIfMajorPerformanceCaveat: true}) !== null;
    this.renderer = new THREE.WebGLRenderer({antialias: hasCard});
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.bodies = geometry.bodies.map((body) => placed(new THREE.Group(), body));
    this.root.add(...this.bodies);
    const materials = new Map();
    for (const geom of geometry.geoms) {
      const shape = geom.shape === "mesh" ? meshes[geom.mesh] : shapeOf(geom, geometry.view);
      const mesh = new THREE.Mesh(mapped(shape, geom), this.material(geom, textures, materials));
      this.bodies[geom.body].add(placed(mesh, geom));
    }
    this.sites = geometry.sites.map((site) => {
      const mesh = new THREE.Mesh(shapeOf(site, geometry.view),
        this.material(site, textures, materials));
      mesh.visible = false;
      this.bodies[site.body].add(placed(mesh, site));
      return mesh;
    });
    const radius = geometry.view.contact_radius;
    const disc = new THREE.CylinderGeometry(radius, radius, radius / 3, SEGMENTS);
    this.contacts = new THREE.InstancedMesh(disc,
      new THREE.MeshPhongMaterial({color: 0xff8c1a, emissive: 0x663300}), MOST_CONTACTS);
    this.contacts.count = 0;
    this.contacts.frustumCulled = false;
    this.root.add(this.contacts);
    this.addCameras();
    this.addLights();
    this.addSky(textures.find((each) => each.kind === "skybox"));
    box.replaceChildren(this.renderer.domElement);
    this.controls = new THREE.OrbitControls(this.free, this.renderer.domElement);
    this.controls.target.fromArray(geometry.view.center);
    this.controls.addEventListener("change", () => { this.isDirty = true; });
    this.controls.update();
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(box);
    this.resize();
  }

  // What one may look with, by name: the free camera, the same along with a body, the model's own.
  get views() {
    const {roots, bodies, cameras} = this.geometry;
    return new Map([
      ...roots.map((body) => [`follow ${bodies[body].name || `body ${body}`}`, {body}]),
      ["free camera", {}],
      ...cameras.map((camera, number) => [`camera ${camera.name}`, {camera: number}]),
    ]);
  }

  // Look with one of the views.
  look({body, camera}) {
    this.camera = this.cameras[camera] ?? this.free;
    this.controls.enabled = this.camera === this.free;
    this.followed = this.bodies[body];
    if (this.followed) this.approach(body);
    this.before = this.followed?.position.clone();
    this.resize();
  }

  // Keep the free camera where that of another scene is.
  lookAs(other) {
    this.free.position.copy(other.free.position);
    this.controls.target.copy(other.controls.target);
    this.approached = other.approached;
    this.controls.update();
  }

  // Move the free camera and what it looks at.
  move(to, from) {
    const way = to.clone().sub(from);
    this.free.position.add(way);
    this.controls.target.add(way);
    this.controls.update();
  }

  // Go so near to a body that it fills a part of the view, unless the camera is at it already.
  approach(body) {
    const {bodies, roots, reaches = [], view} = this.geometry;
    if (this.approached === bodies[body].name) return;
    this.approached = bodies[body].name;
    const {target} = this.controls;
    const way = this.free.position.clone().sub(target);
    target.copy(this.followed.position);
    way.setLength(STEP_BACK * (reaches[roots.indexOf(body)] || view.extent / 2));
    this.free.position.copy(target).add(way);
    this.controls.update();
  }

  showSites(isOn) {
    for (const site of this.sites) site.visible = isOn;
    this.isDirty = true;
  }

  // Poses between those of two frames, which are rows of numbers; share 0: the first.
  place(first, second, share) {
    const {moving, moving_cameras: cameras} = this.geometry;
    const objects = [...moving.map((body) => this.bodies[body]),
      ...cameras.map((camera) => this.cameras[camera])];
    if (first.length !== objects.length * POSE || second.length !== first.length) return;
    const [from, to] = [new THREE.Quaternion(), new THREE.Quaternion()];
    objects.forEach((object, row) => {
      const at = row * POSE;
      const mean = (place) => first[place] + share * (second[place] - first[place]);
      object.position.set(mean(at), mean(at + 1), mean(at + 2));
      from.set(first[at + 4], first[at + 5], first[at + 6], first[at + 3]);
      to.set(second[at + 4], second[at + 5], second[at + 6], second[at + 3]);
      object.quaternion.slerpQuaternions(from, to, share);
    });
    if (this.followed) {
      this.move(this.followed.position, this.before);
      this.before.copy(this.followed.position);
    }
    this.isDirty = true;
  }

  // Discs where bodies touch; rows of points and normals.
  touch(contacts) {
    const count = Math.min(MOST_CONTACTS, contacts.length / CONTACT);
    if (!count && !this.contacts.count) return;
    const [up, normal, turn] = [new THREE.Vector3(0, 1, 0), new THREE.Vector3(),
      new THREE.Quaternion()];
    for (let row = 0; row < count; row += 1) {
      normal.fromArray(contacts, row * CONTACT + 3);
      this.contacts.setMatrixAt(row, new THREE.Matrix4()
        .makeRotationFromQuaternion(turn.setFromUnitVectors(up, normal))
        .setPosition(new THREE.Vector3().fromArray(contacts, row * CONTACT)));
    }
    this.contacts.count = count;
    this.contacts.instanceMatrix.needsUpdate = true;
    this.isDirty = true;
  }

  // Returns whether there was something new to draw.
  draw() {
    if (!this.isDirty) return false;
    this.isDirty = false;
    this.camera.add(this.headlight, this.headlight.target);
    this.renderer.render(this.root, this.camera);
    return true;
  }

  dispose() {
    this.observer.disconnect();
    this.controls.dispose();
    this.root.traverse((object) => object.geometry?.dispose());
    this.renderer.dispose();
    this.renderer.domElement.remove();
  }

  resize() {
    const [width, height] = [this.box.clientWidth || 1, this.box.clientHeight || 1];
    this.renderer.setSize(width, height);
    for (const camera of [this.free, ...this.cameras]) {
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    this.isDirty = true;
    this.draw(); // now: a canvas that gets another size is black
  }

  material(geom, textures, known) {
    const key = JSON.stringify([geom.rgba, geom.emission, geom.specular, geom.shininess,
      geom.texture, geom.shape === "plane"]);
    if (known.has(key)) return known.get(key);
    const {rgba, specular = 0.5, shininess = 0.5, emission = 0} = geom;
    const color = new THREE.Color(...rgba.slice(0, 3));
    const material = new THREE.MeshPhongMaterial({
      color, opacity: rgba[3], transparent: rgba[3] < 1, depthWrite: rgba[3] === 1,
      emissive: color.clone().multiplyScalar(emission), shininess: 128 * shininess,
      specular: new THREE.Color().setScalar(0.1 * specular),
      ...geom.shape === "plane" ? {side: THREE.DoubleSide} : {},
    });
    const texture = textures[geom.texture];
    if (texture?.pixels) {
      material.map = new THREE.DataTexture(texture.pixels, texture.width, texture.height);
      material.map.wrapS = material.map.wrapT = THREE.RepeatWrapping;
      material.map.magFilter = THREE.LinearFilter;
      material.map.minFilter = THREE.LinearMipmapLinearFilter;
      material.map.generateMipmaps = true;
      material.map.anisotropy = this.renderer.capabilities.getMaxAnisotropy();
      material.map.needsUpdate = true;
    } else if (texture) color.multiply(new THREE.Color(...texture.mean.slice(0, 3)));
    known.set(key, material);
    return material;
  }

  addCameras() {
    const {view, cameras} = this.geometry;
    const made = (fovy) => {
      const camera = new THREE.PerspectiveCamera(fovy, 1, view.near, view.far);
      camera.up.set(0, 0, 1);
      return camera;
    };
    this.cameras = cameras.map((each, number) => {
      const camera = placed(made(each.fovy), each);
      const moves = this.geometry.moving_cameras.includes(number); // in the world, by itself
      (moves ? this.root : this.bodies[each.body]).add(camera);
      return camera;
    });
    this.camera = this.free = made(view.fovy);
    const [turn, rise] = [view.azimuth, view.elevation].map((degrees) => degrees * Math.PI / 180);
    const ahead = new THREE.Vector3(Math.cos(rise) * Math.cos(turn),
      Math.cos(rise) * Math.sin(turn), Math.sin(rise));
    this.free.position.fromArray(view.center).addScaledVector(ahead, -1.5 * view.extent);
    this.root.add(this.free);
  }

  addLights() {
    const {lights, headlight} = this.geometry;
    const ambient = new THREE.Color(...headlight.ambient);
    this.headlight = new THREE.DirectionalLight(new THREE.Color(...headlight.diffuse), LIGHT);
    this.headlight.position.set(0, 0, 0);
    this.headlight.target.position.set(0, 0, -1);
    for (const each of lights) {
      ambient.add(new THREE.Color(...each.ambient));
      const color = new THREE.Color(...each.diffuse);
      const light = each.type === DIRECTIONAL ? new THREE.DirectionalLight(color, LIGHT)
        : each.type === SPOT ? new THREE.SpotLight(color, LIGHT, 0,
          Math.min(each.cutoff, 90) * Math.PI / 180, 0.3, 0)
        : new THREE.PointLight(color, LIGHT, 0, 0);
      light.position.fromArray(each.pos);
      this.bodies[each.body].add(light);
      if (light.target) {
        light.target.position.fromArray(each.pos).add(new THREE.Vector3(...each.dir));
        this.bodies[each.body].add(light.target);
      }
    }
    this.root.add(new THREE.AmbientLight(ambient, LIGHT));
  }

  addSky(sky) {
    this.root.background = new THREE.Color(0.2, 0.25, 0.3);
    if (!sky) return;
    const size = sky.width; // six squares, one below the other; or one for all
    const faces = [0, 1, 2, 3, 4, 5].map((face) => {
      const canvas = document.createElement("canvas");
      canvas.width = canvas.height = size;
      const begin = sky.height === size ? 0 : 4 * size * size * face;
      const pixels = new Uint8ClampedArray(sky.pixels.buffer, begin, 4 * size * size);
      canvas.getContext("2d").putImageData(new ImageData(pixels, size), 0, 0);
      return canvas;
    });
    const texture = new THREE.CubeTexture(faces);
    texture.needsUpdate = true;
    this.root.background = texture;
    this.root.backgroundRotation.x = Math.PI / 2; // z is up
  }
}

function placed(object, {pos, quat: [w, x, y, z]}) {
  object.position.fromArray(pos);
  object.quaternion.set(x, y, z, w);
  return object;
}

async function meshGeometry({position, normal, uv, index}) {
  const geometry = new THREE.BufferGeometry();
  const parts = Object.entries({position, normal, uv}).filter(([, text]) => text);
  for (const [name, text] of parts) {
    const values = await unpacked(text, Float32Array);
    geometry.setAttribute(name, new THREE.BufferAttribute(values, name === "uv" ? 2 : 3));
  }
  geometry.setIndex(new THREE.BufferAttribute(await unpacked(index, Uint32Array), 1));
  if (!normal) geometry.computeVertexNormals();
  return geometry;
}

// Sizes are half lengths, and the axis of what has one is z.
function shapeOf({shape, size: [a, b, c]}, view) {
  const far = Math.min(view.far, 50 * view.extent);
  const upright = (geometry) => geometry.rotateX(Math.PI / 2);
  return {
    plane: () => new THREE.PlaneGeometry(2 * (a || far), 2 * (b || far)),
    sphere: () => new THREE.SphereGeometry(a, SEGMENTS, SEGMENTS),
    capsule: () => upright(new THREE.CapsuleGeometry(a, 2 * b, SEGMENTS / 3, SEGMENTS)),
    ellipsoid: () => new THREE.SphereGeometry(1, SEGMENTS, SEGMENTS).scale(a, b, c),
    cylinder: () => upright(new THREE.CylinderGeometry(a, a, 2 * b, SEGMENTS)),
    box: () => new THREE.BoxGeometry(2 * a, 2 * b, 2 * c),
  }[shape]();
}

// A 2-D texture lies on the x-y plane: so many times per object, or per two metres.
function mapped(geometry, {texture, repeat, size, shape, is_uniform: isUniform}) {
  if (texture === undefined || (shape === "mesh" && geometry.attributes.uv)) return geometry;
  const {position} = geometry.attributes;
  const uv = new Float32Array(2 * position.count);
  const per = (axis) => repeat[axis] / (isUniform || !size[axis] ? 2 : 2 * size[axis]);
  for (let place = 0; place < position.count; place += 1) {
    uv[2 * place] = position.getX(place) * per(0) + 0.5;
    uv[2 * place + 1] = -position.getY(place) * per(1) - 0.5;
  }
  return geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
}
