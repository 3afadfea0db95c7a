// The shortest complete program: every rank has one brick with a glass ball in it; rank 0 writes the picture.
//   mpirun -n 4 minimal        writes minimal.ppm
#include <dfb/dfb.hpp>

#include <cmath>
#include <fstream>

int main(int argc, char** argv)
{
    int level = 0;
    MPI_Init_thread(&argc, &argv, MPI_THREAD_MULTIPLE, &level);
    {
        const int width = 640, height = 320;
        dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(MPI_COMM_WORLD, {width, height, dfb::OutputFormat::SRGBA8});
        const auto rank = static_cast<float>(fb.rank()), ranks = static_cast<float>(fb.size());
        const float angle = 6.2832f * rank / ranks, ring = std::fmax(2.0f, 0.4f * ranks);
        const dfb::Vec3 center{ring * std::cos(angle), 0, ring * std::sin(angle)}, half{1, 1, 1};
        const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {center - half, center + half}}});
        const dfb::PerspectiveCamera camera({0, 1.5f * ring, 4 * ring}, {0, 0, 0}, {0, 1, 0}, 30);

        dfb::renderDataParallel(fb, world, camera, [&](const dfb::Brick&, auto& tile) {
            for (int y = 0; y < tile.region.height(); ++y)
                for (int x = 0; x < tile.region.width(); ++x) {
                    const auto ray = camera.direction(tile.region.x0 + x + 0.5, tile.region.y0 + y + 0.5, width, height);
                    const dfb::Vec3 way = center - camera.eye();
                    const float middle = dot(ray, way), inside = 1 - dot(way, way) + middle * middle;
                    if (inside <= 0)
                        continue; // the ray misses the ball
                    const float halfChord = std::sqrt(inside), alpha = 1 - std::exp(-halfChord);
                    float* pixel = tile.pixel(x, y); // premultiplied RGBA
                    pixel[0] = pixel[3] = alpha;
                    pixel[1] = alpha * (0.5f + 0.5f * std::cos(angle));
                    pixel[2] = alpha * (0.5f + 0.5f * std::sin(angle));
                    tile.depth[y * tile.size + x] = middle - halfChord;
                }
        });

        if (fb.isDisplayRank()) {
            std::ofstream file("minimal.ppm", std::ios::binary);
            file << "P6\n" << width << ' ' << height << "\n255\n";
            for (std::size_t i = 0; i < fb.image().pixelCount(); ++i)
                file.write(reinterpret_cast<const char*>(fb.image().rgba8() + 4 * i), 3);
        }
    }
    MPI_Finalize();
}
