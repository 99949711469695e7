// Calls OpenSplat's functions of the CPU in the order of its model.cpp, without its images, its trainer and OpenCV.
#include "bindings.h"
#include <torch/extension.h>

static torch::Tensor render(torch::Tensor means, torch::Tensor quats, torch::Tensor scales, torch::Tensor opacities,
                            torch::Tensor coefficients, torch::Tensor directions, torch::Tensor view,
                            torch::Tensor clip_from_world, torch::Tensor background, std::vector<double> camera,
                            int width, int height, int degree) {
    const int n = means.size(0);
    auto [centres, radii, conics, covariances, depths] = project_gaussians_forward_tensor_cpu(
        n, means, scales, 1, quats, view, clip_from_world, camera[0], camera[1], camera[2], camera[3], height, width, 0.01f);
    auto shaded = compute_sh_forward_tensor_cpu(n, degree, degree, directions, coefficients);
    auto colors = torch::clamp_min(shaded + 0.5f, 0.0f).contiguous();
    auto [image, transmittance, hits] = rasterize_forward_tensor_cpu(
        width, height, centres.contiguous(), conics.contiguous(), colors, opacities, background, covariances, depths.contiguous());
    delete[] hits;
    return image;
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, module) { module.def("render", &render); }
