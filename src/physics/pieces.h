// Contacts between bodies made of convex pieces, and islands made by contacts.
#pragma once

#include <BulletCollision/CollisionDispatch/btCollisionCreateFunc.h>
#include <BulletCollision/CollisionDispatch/btDefaultCollisionConfiguration.h>
#include <BulletCollision/CollisionShapes/btCompoundShape.h>
#include <BulletCollision/CollisionShapes/btConvexInternalShape.h>
#include <BulletDynamics/Featherstone/btMultiBodyDynamicsWorld.h>

#include <memory>
#include <vector>

class btConvexPolyhedron;

namespace iwgnet_grasp::physics {

// The shape of every body here: convex pieces with their bounds. Owns the pieces.
class PiecesShape : public btCompoundShape {
 public:
  PiecesShape() : btCompoundShape(false) {}
  void add(std::unique_ptr<btConvexInternalShape> shape, const btTransform& T_body_piece);

  struct Piece {
    std::unique_ptr<btConvexInternalShape> shape;
    btTransform T_body_piece;
    btVector3 center, half;  // m, axis-aligned bounds in the body's frame
    const btConvexPolyhedron* polyhedron = nullptr;  // its faces, where it has some
    btScalar polyhedron_margin = 0.0;                // m that the piece is rounded beyond them
  };
  const std::vector<Piece>& pieces() const { return pieces_; }
  btScalar radius() const { return radius_; }  // m, no point lies further from the body's origin

 private:
  btScalar radius_ = 0.0;
  std::vector<Piece> pieces_;
};

// Bullet's own compound algorithm keeps a manifold of up to four points for each pair of pieces:
// two rods of twenty pieces each would carry hundreds of contacts. This one keeps one manifold for
// each direction in which two bodies touch. A list of the pairs of pieces that are near each other
// is made anew only after the bodies have moved against each other.
class PiecesConfiguration : public btDefaultCollisionConfiguration {
 public:
  PiecesConfiguration();
  btCollisionAlgorithmCreateFunc* getCollisionAlgorithmCreateFunc(int type_a, int type_b) override;

 private:
  std::unique_ptr<btCollisionAlgorithmCreateFunc> create_;
};

// Bullet joins bodies to an island as soon as their bounding boxes overlap, so that the arm above
// a heap would keep it awake; here only contact joins them.
class ContactIslandWorld : public btMultiBodyDynamicsWorld {
 public:
  using btMultiBodyDynamicsWorld::btMultiBodyDynamicsWorld;

 protected:
  void calculateSimulationIslands() override;
};

}  // namespace iwgnet_grasp::physics
