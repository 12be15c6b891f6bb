// What the report's scene needs of three.js; see README.md.
export {AmbientLight, BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry,
  DirectionalLight, DoubleSide, GridHelper, Group, HemisphereLight, Line, LineBasicMaterial, Mesh,
  MeshLambertMaterial, PerspectiveCamera, Quaternion, Scene, SphereGeometry, Vector3,
  WebGLRenderer} from 'three';
export {OrbitControls} from 'three/examples/jsm/controls/OrbitControls.js';
